#!/usr/bin/env bash
# This does not reproduce the shipped weights: their first two legs saw no decoys, and their third none that touch the
# person; all do now. Legs also end by time, not by steps.
# A Parsing Network: synthetic people from head to chest, nothing else. Two processor cores, about five hours.
# Run it again after an interruption: it goes on. MAPS are environment maps that people stand before in the third leg
# (examples/add_backgrounds.py).
# Usage: [PEOPLE=240] [MAPS="a.hdr b.hdr"] examples/train_parsing.sh ICT-FaceKit.tar.xz RUN [TIME] [OF THE THIRD LEG]
set -euo pipefail
archive=$1 run=$2 time=${3:-75m}
export OMP_NUM_THREADS=1
export MALLOC_MMAP_THRESHOLD_=1073741824 MALLOC_TRIM_THRESHOLD_=4294967296  # else much of the time is the kernel's
mkdir -p "$run"
[ -f "$run/ict.npz" ] || facerf face-model import "$archive" -o "$run/ict.npz"
facerf train --stage parsing --seed 15 --heads-from "builtin,$run/ict.npz" --heads "${PEOPLE:-240}" --bank "$run/bank" \
    -j 2 --max-time "$time" --validate-every 400 --workers 1 --resume -o "$run/parsing"
facerf train --stage parsing --seed 16 --learning-rate 1e-3 --heads-from "builtin,$run/ict.npz" --heads "${PEOPLE:-240}" \
    --bank "$run/bank" -j 2 --max-time "$time" --validate-every 400 --workers 1 --resume \
    --start-from "$run/parsing/best.safetensors" -o "$run/parsing2"
python "$(dirname "$0")/mean_of_checkpoints.py" "$run/parsing/best.safetensors" "$run/parsing2/best.safetensors" \
    "$run/parsing12.safetensors"
[ -f "$run/bank3/backgrounds.safetensors" ] || \
    python "$(dirname "$0")/add_backgrounds.py" "$run/bank3" ${MAPS:-}
facerf train --stage parsing --seed 51 --learning-rate 1e-3 --heads-from "builtin,$run/ict.npz" --heads 64 \
    --bank "$run/bank3" -j 2 --max-time "${4:-55m}" --validate-every 400 --workers 1 --resume \
    --start-from "$run/parsing12.safetensors" -o "$run/parsing3"
python "$(dirname "$0")/mean_of_checkpoints.py" "$run/parsing12.safetensors" "$run/parsing3/last.safetensors" \
    "$run/parsing.safetensors" 0.3
