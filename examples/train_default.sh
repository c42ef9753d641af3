#!/usr/bin/env bash
# This does not reproduce the shipped weights: those are the fourth run of a chain (docs/training.md); this is one run.
# The data are those of the default checkpoint: heads of ICT-FaceKit (MIT), fitted with the built-in model as photos are.
# Run it again after an interruption: what is finished is kept, and the runs go on where they were saved.
# Usage: examples/train_default.sh ICT-FaceKit.tar.xz RUN [TIME]
set -euo pipefail
archive=$1 run=$2 time=${3:-2h}
mkdir -p "$run"
[ -f "$run/ict.npz" ] || facerf face-model import "$archive" -o "$run/ict.npz"
heads=(--heads-from "$run/ict.npz" --heads 400 --bank "$run/bank")
facerf train -o "$run/reflectance" --resume "${heads[@]}" --max-time "$time"
facerf train -o "$run/both" --resume --stage geometry "${heads[@]}" --batch 24 --max-time 20m \
    --start-from "$run/reflectance/best.safetensors"
facerf relight examples/astronaut.jpg --envmap examples/maps --checkpoint "$run/both/best.safetensors" -o "$run/look"
