#!/usr/bin/env bash
# The paper's own form and training on two processor cores, at 128 texels (the paper: 512), without downloads.
# Synthetic people stand for the light stage, photographs of other synthetic people in natural light for FFHQ, and
# a VGG-16 that is trained on people and lights for ImageNet's. Run it again after an interruption: it goes on.
# PEOPLE and OTHERS are numbers of people, an eighth of PEOPLE is held out; crops of 192 px are enough for 128 texels.
# Usage: [PEOPLE=36] [OTHERS=16] examples/train_paper.sh ICT-FaceKit.tar.xz RUN [TIME] [MAPS]
set -euo pipefail
here=$(dirname "$0") archive=$1 run=$2 time=${3:-2h} maps=${4:-procedural:40}
people=${PEOPLE:-36} others=${OTHERS:-16}
tested=$((people / 8)) validated=2
stage=(--face-model "$run/ict.npz" --size 192 -j 2)
export OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE
export MALLOC_MMAP_THRESHOLD_=1073741824 MALLOC_TRIM_THRESHOLD_=4294967296  # else a fifth of the time is the kernel's
mkdir -p "$run"
[ -f "$run/ict.npz" ] || facerf face-model import ict-facekit "$archive" -o "$run/ict.npz"

# People under 150 lights for the pairs, others under 50 lights for the photographs.
facerf synth-stage --seed 14 --subjects "$people" "${stage[@]}" -o "$run/capture"
facerf prepare-dataset "$run/capture" --split "$((people - validated - tested))/$validated/$tested" --crop 192 \
    --checks off -j 2 -o "$run/dataset"
facerf relight-dataset "$run/dataset" --envmaps procedural:120 --per-subject 240 -j 2
facerf synth-stage --seed 314 --subjects "$others" --lights 50 "${stage[@]}" -o "$run/capture2"
facerf prepare-dataset "$run/capture2" --split "$others/0/0" --crop 192 --checks off -j 2 -o "$run/dataset2"
facerf relight-dataset "$run/dataset2" --envmaps "$maps" --per-subject 25 -j 2
[ -d "$run/photos" ] || python "$here/natural_photos.py" "$run/dataset2" "$run/photos"

paper=(--preset paper --dataset "$run/dataset" --texture-size 128 --workers 0)
facerf train -o "$run/light" --stage light-features "${paper[@]}" --resume --batch 2 --max-time 5m &
facerf train -o "$run/appearance" --stage appearance-features "${paper[@]}" --resume --batch 4 --max-time 6m &
wait
# It is saved with each validation: an interruption costs no more than 250 steps.
facerf train -o "$run/paper" "${paper[@]}" --resume --photos "$run/photos" --max-time "$time" --validate-every 250 \
    --appearance-features "$run/appearance/best.safetensors" --light-features "$run/light/best.safetensors"
