#!/usr/bin/env bash
# The shipped Parsing Network: synthetic people from head to chest, nothing else. Two processor cores, about four hours.
# Run it again after an interruption: it goes on.
# Usage: [PEOPLE=240] examples/train_parsing.sh ICT-FaceKit.tar.xz RUN [TIME]
set -euo pipefail
archive=$1 run=$2 time=${3:-75m}
export OMP_NUM_THREADS=1
export MALLOC_MMAP_THRESHOLD_=1073741824 MALLOC_TRIM_THRESHOLD_=4294967296  # else much of the time is the kernel's
mkdir -p "$run"
[ -f "$run/ict.npz" ] || facerf face-model import ict-facekit "$archive" -o "$run/ict.npz"
facerf train --stage parsing --seed 15 --heads-from "builtin,$run/ict.npz" --heads "${PEOPLE:-240}" --bank "$run/bank" \
    -j 2 --max-time "$time" --validate-every 400 --workers 1 --resume -o "$run/parsing"
facerf train --stage parsing --seed 16 --learning-rate 1e-3 --heads-from "builtin,$run/ict.npz" --heads "${PEOPLE:-240}" \
    --bank "$run/bank" -j 2 --max-time "$time" --validate-every 400 --workers 1 --resume \
    --start-from "$run/parsing/best.safetensors" -o "$run/parsing2"
python "$(dirname "$0")/mean_of_checkpoints.py" "$run/parsing/best.safetensors" "$run/parsing2/best.safetensors" \
    "$run/parsing.safetensors"
