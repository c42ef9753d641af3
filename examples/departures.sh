#!/usr/bin/env bash
# What facerf's departures from the paper buy: from the paper's form to the shipped one, a departure a row, and the
# paper's two ablations, each trained from scratch for the same time of one core and measured on the same people and
# on Extended Yale B. RUN is the folder of train_paper.sh. Run it on an idle core: the time is that of the clock.
# Usage: [SUBJECTS=yaleB01,yaleB02] examples/departures.sh RUN [TIME] [EXTENDED_YALE_B SHIFTS.csv]
set -euo pipefail
run=$1 time=${2:-20m} yale=${3:-} shifts=${4:-}
export OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE
export MALLOC_MMAP_THRESHOLD_=1073741824 MALLOC_TRIM_THRESHOLD_=4294967296  # else a fifth of the time is the kernel's
dataset=(--dataset "$run/dataset" --texture-size 128)
joint=("${dataset[@]}" --preset paper --appearance-features "$run/appearance/best.safetensors"
    --light-features "$run/light/best.safetensors")
photos=(--photos "$run/photos") # they train the Geometry Network
heads=(--heads-from "$run/ict.npz" --heads 60 --bank "$run/bank")

train() {  # NAME OPTIONS...: a run, measured
    local name=$1 out=$run/departures/$1
    shift
    facerf train -o "$out" --resume --workers 0 --max-time "$time" "$@"
    facerf --checkpoint "$out/last.safetensors" evaluate olat "$run/dataset" --network-alone --every 20 -o "$out/olat"
    if [ -n "$yale" ]; then
        facerf --checkpoint "$out/last.safetensors" evaluate yale-b "$yale" --shifts "$shifts" --network-alone \
            ${SUBJECTS:+--subjects "$SUBJECTS"} -o "$out/yale-b"
    fi
}

train paper "${joint[@]}" "${photos[@]}"
train without-normals "${joint[@]}" "${photos[@]}" --without-normals
train mean-face "${joint[@]}" "${photos[@]}" --mean-face
train geometry "${joint[@]}" --geometry landmarks
train loss --preset paper --stage reflectance "${dataset[@]}"
train data --preset paper --stage reflectance "${heads[@]}"
train optimizer --form paper "${heads[@]}"
train architecture "${heads[@]}"
