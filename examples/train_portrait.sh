#!/usr/bin/env bash
# The shipped Portrait Network: synthetic people from head to chest, nothing else. Two processor cores, about two hours.
# Run it again after an interruption: it goes on.
# Usage: [PEOPLE=340] examples/train_portrait.sh ICT-FaceKit.tar.xz RUN [TIME]
set -euo pipefail
archive=$1 run=$2 time=${3:-75m}
export OMP_NUM_THREADS=2
export MALLOC_MMAP_THRESHOLD_=1073741824 MALLOC_TRIM_THRESHOLD_=4294967296  # else much of the time is the kernel's
mkdir -p "$run"
[ -f "$run/ict.npz" ] || facerf face-model import ict-facekit "$archive" -o "$run/ict.npz"
facerf train --stage portrait --seed 16 --heads-from "builtin,$run/ict.npz" --heads "${PEOPLE:-340}" --bank "$run/bank" \
    -j 2 --max-time "$time" --validate-every 250 --workers 1 --resume -o "$run/portrait"
