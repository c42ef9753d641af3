#!/usr/bin/env bash
# This does not reproduce the shipped weights: those are of an earlier recipe, whose squares were of three faces alone.
# A Portrait Network: synthetic people from face to hips, nothing else. Two processor cores, about seven hours: two to bake
# the people, two for a first leg of training, three for a second one that starts from it.
# Run it again after an interruption: it goes on. To go on from the shipped one, give only the second command, with
# --start-from facerf_cli/assets/portrait.safetensors.
# Usage: [PEOPLE=340] examples/train_portrait.sh ICT-FaceKit.tar.xz RUN [TIME OF THE FIRST LEG] [OF THE SECOND]
set -euo pipefail
archive=$1 run=$2 first=${3:-120m} second=${4:-180m}
export OMP_NUM_THREADS=2
export MALLOC_MMAP_THRESHOLD_=1073741824 MALLOC_TRIM_THRESHOLD_=4294967296  # else much of the time is the kernel's
mkdir -p "$run"
[ -f "$run/ict.npz" ] || facerf face-model import "$archive" -o "$run/ict.npz"
people=(--stage portrait --heads-from "builtin,$run/ict.npz" --heads "${PEOPLE:-340}" --bank "$run/bank" -j 2 --workers 1)
facerf train "${people[@]}" --seed 16 --max-time "$first" --validate-every 250 --resume -o "$run/first"
facerf train "${people[@]}" --seed 17 --max-time "$second" --validate-every 500 --resume -o "$run/portrait" \
    --start-from "$run/first/best.safetensors"
