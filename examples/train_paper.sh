#!/usr/bin/env bash
# The paper's own form and training on two processor cores, at 128 texels (the paper: 512), without downloads.
# Synthetic people stand for the light stage, photographs of other synthetic people in natural light for FFHQ, and
# a VGG-16 that is trained on people and lights for ImageNet's. Run it again after an interruption: it goes on.
# Usage: examples/train_paper.sh ICT-FaceKit.tar.xz RUN [TIME] [MAPS]
set -euo pipefail
here=$(dirname "$0") archive=$1 run=$2 time=${3:-2h} maps=${4:-procedural:40}
export OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE
mkdir -p "$run"
[ -f "$run/ict.npz" ] || facerf face-model import ict-facekit "$archive" -o "$run/ict.npz"

# 36 people under 150 lights for the pairs, 16 others under 50 lights for the photographs.
facerf synth-stage --seed 14 --subjects 36 --face-model "$run/ict.npz" -j 2 -o "$run/capture"
facerf prepare-dataset "$run/capture" --split 28/2/6 --checks off -j 2 -o "$run/dataset"
facerf relight-dataset "$run/dataset" --envmaps procedural:400 --per-subject 240 -j 2
facerf synth-stage --seed 314 --subjects 16 --lights 50 --face-model "$run/ict.npz" -j 2 -o "$run/capture2"
facerf prepare-dataset "$run/capture2" --split 16/0/0 --checks off -j 2 -o "$run/dataset2"
facerf relight-dataset "$run/dataset2" --envmaps "$maps" --per-subject 25 -j 2
[ -d "$run/photos" ] || python "$here/natural_photos.py" "$run/dataset2" "$run/photos"

paper=(--preset paper --dataset "$run/dataset" --texture-size 128 --workers 0)
facerf train -o "$run/light" --stage light-features "${paper[@]}" --resume --batch 2 --max-time 5m &
facerf train -o "$run/appearance" --stage appearance-features "${paper[@]}" --resume --batch 4 --max-time 6m &
wait
facerf train -o "$run/paper" "${paper[@]}" --resume --bf16 --photos "$run/photos" --max-time "$time" \
    --appearance-features "$run/appearance/best.safetensors" --light-features "$run/light/best.safetensors"
