#!/usr/bin/env bash
# How the default checkpoint was trained: heads of ICT-FaceKit (MIT), fitted with the built-in model as photos are.
# Run it again after an interruption: what is finished is kept, and the run goes on where it was saved.
# Usage: examples/train_default.sh ICT-FaceKit.tar.xz RUN [TIME]
set -euo pipefail
archive=$1 run=$2 time=${3:-2h}
mkdir -p "$run"
[ -f "$run/ict.npz" ] || facerf face-model import ict-facekit "$archive" -o "$run/ict.npz"
facerf train -o "$run" --resume --heads-from "$run/ict.npz" --fit-with builtin --heads 260 --views 8 --max-time "$time"
facerf relight examples/astronaut.jpg --envmap examples/maps --checkpoint "$run/best.safetensors" -o "$run/look"
