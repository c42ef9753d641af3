#!/bin/sh
# This does not reproduce the shipped weights: it starts from them.
# Train the Portrait Network on a machine with a GPU: bake people on all cores for a while, then train from the
# shipped weights, with samples drawn on all cores. RUN has the weights (last, best), log.jsonl and the settings.
#
#   tools/train_on_device.sh RUN [BAKE_SECONDS [TRAIN_SECONDS [facerf train's options...]]]
#
# HEADS_FROM: face models (builtin); DEVICE: of torch (cuda); PYTHON: the interpreter; BANK: folder of the people.
set -eu
run=${1:?give a folder for the run}
bake=${2:-3600} seconds=${3:-7200}
[ $# -gt 3 ] && shift 3 || shift $#
root=$(cd "$(dirname "$0")/.." && pwd)
python=${PYTHON:-python3} models=${HEADS_FROM:-builtin} bank=${BANK:-$run/bank}
export PYTHONPATH="$root${PYTHONPATH:+:$PYTHONPATH}" OMP_NUM_THREADS=1
mkdir -p "$run"
people=$("$python" "$root/tools/bake_people.py" "$bank" --seconds "$bake" --heads-from "$models")
echo "$people people" >&2
cat >"$run/recipe.toml" <<TOML
[train.optimizer]
name = "AdamW"
learning_rate = 3e-4
TOML
"$python" -m facerf_cli --config "$run/recipe.toml" train --stage portrait -o "$run" --bank "$bank" \
    --heads "$people" --heads-from "$models" --start-from "$root/facerf_cli/assets/portrait.safetensors" \
    --device "${DEVICE:-cuda}" --workers "$(nproc --all)" --max-time "${seconds}s" "$@"
