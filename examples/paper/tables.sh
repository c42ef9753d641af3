#!/usr/bin/env bash
# From the capture of a light stage to the paper's Tables 1 to 4, its two ablations and its figures. Run it again after an
# interruption: it goes on.
#   SCALE=paper CAPTURE=stage/ MAPS=hdri/ TEST_MAPS=hdri_test/ PHOTOS=ffhq/ TEST_PHOTOS=celeba/ examples/paper/tables.sh RUN
#   SCALE=small HEADS=ict.npz examples/paper/tables.sh RUN   # 128 texels on two cores, synthetic people, no downloads
#   SCALE=tiny examples/paper/tables.sh RUN                  # minutes of one core: does every step run?
# TIME is the time of each of the trainings that a table compares, SPLIT the people of training, validation and test.
# TRAIN="torchrun --nproc-per-node 8 -m facerf_cli train" trains on eight GPUs. OVERWRITE nothing: remove what is to go.
# CAPTURE without the others takes your stage with drawn maps, and photos of its own people, at any SCALE.
# DEPARTURES=1 trains the steps from the paper's form to the shipped one, too; YALE and SHIFTS measure on Extended Yale B.
set -euo pipefail
here=$(dirname "$0") run=$1 train=${TRAIN:-facerf train}
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1} OMP_WAIT_POLICY=PASSIVE
export MALLOC_MMAP_THRESHOLD_=1073741824 MALLOC_TRIM_THRESHOLD_=4294967296  # else a fifth of the time is the kernel's
mkdir -p "$run"

form=(--preset paper) features=(--max-time "${FEATURES_TIME:-6h}") appearance_features=(--vgg-weights imagenet)
case ${SCALE:-paper} in
paper)
    split=${SPLIT:-300/10/40} crop=512 each=1000 length=(--max-time "${TIME:-200h}") diffuse=(--texture-size 128) ;;
small)
    split=${SPLIT:-30/2/4} crop=192 each=240 length=(--max-time "${TIME:-2h}" --validate-every 250)
    features=(--max-time 6m) form=(--preset paper --texture-size 128 --workers 0) diffuse=(--texture-size 128 --workers 0)
    stage=(--subjects 36 --size 192 --seed 14 --face-model "${HEADS:-builtin}") ;;
tiny)
    split=${SPLIT:-2/1/1} crop=96 each=4 length=(--steps 2) features=(--steps 2)
    form=(--preset tiny --texture-size 32 --workers 0) diffuse=("${form[@]}")
    stage=(--subjects 4 --size 128 --seed 14 --lights 12 --cameras 2) ;;
esac

# The dataset: crops, pairs under maps that the test does not share, photos.
capture=${CAPTURE:-$run/capture} maps=${MAPS:-procedural:120} test_maps=${TEST_MAPS:-procedural:40}
[ -n "${CAPTURE:-}" ] || facerf synth-stage "${stage[@]}" -j 2 -o "$capture"
[ -f "$run/dataset/dataset.json" ] || facerf prepare-dataset "$capture" --split "$split" --crop "$crop" -o "$run/dataset"
facerf relight-dataset "$run/dataset" --envmaps "$maps" --envmaps-test "$test_maps" --per-subject "$each"
photos=${PHOTOS:-$run/photos} test_photos=${TEST_PHOTOS:-$run/dataset}
[ -d "$photos" ] || python "$here/../natural_photos.py" "$run/dataset" "$photos" 25

# S_f, and where ImageNet's VGG-16 is not wanted a V_f of our own.
data=(--dataset "$run/dataset" "${form[@]}")
$train -o "$run/light" --stage light-features "${data[@]}" --resume "${features[@]}"
if [ "${SCALE:-paper}" != paper ]; then
    $train -o "$run/appearance" --stage appearance-features "${data[@]}" --resume "${features[@]}"
    appearance_features=(--appearance-features "$run/appearance/best.safetensors")
fi

joint() {  # NAME OPTIONS...: the paper's training, or an ablation of it
    $train -o "$run/$1" --stage joint --form paper "${data[@]}" --photos "$photos" "${appearance_features[@]}" \
        --light-features "$run/light/best.safetensors" --resume "${length[@]}" "${@:2}"
    cp "$run/$1/best.safetensors" "$run/$1.safetensors"
}
joint paper
joint without-normals --without-normals
joint mean-face --mean-face
$train -o "$run/diffuse-sh" --stage diffuse-sh --dataset "$run/dataset" "${diffuse[@]}" --resume "${length[@]}"

# The tables. Rows of other methods: facerf evaluate cases, then compare (docs/evaluation.md).
measure=(facerf --checkpoint "$run/paper.safetensors" evaluate)
"${measure[@]}" olat "$run/dataset" --preset paper --network-alone -o "$run/tables/1" # rows 'same' and 'different pose'
rivals=(--reflectance field --reflectance diffuse-sh --reflectance specular-sh --reflectance prt)
solve=(--signed --refine features)
two=(facerf --checkpoint "$run/paper.safetensors" --checkpoint "$run/diffuse-sh" --checkpoint "$run/light" evaluate)
"${two[@]}" reconstruction "$test_photos" --preset paper "${rivals[@]}" "${solve[@]}" -o "$run/tables/2-reconstruction"
"${two[@]}" transfer "$run/dataset" --preset paper "${rivals[@]}" "${solve[@]}" -o "$run/tables/2-transfer"
"${measure[@]}" olat "$run/dataset" --preset paper --network-alone \
    --against "$run/without-normals.safetensors" -o "$run/tables/3"
"${measure[@]}" geometry "$test_photos" --preset paper --mean-checkpoint "$run/mean-face.safetensors" -o "$run/tables/4"

# The figures, of the first photos.
mapfile -d '' -t shown < <(find "$photos" -not -path '*/.*' \( -name '*.png' -o -name '*.jpg' \) -print0 | sort -z | head -z -n "${SHOWN:-4}")
python "$here/figures.py" "$run/figures" "$run/paper.safetensors" "${shown[@]}"

[ -n "${DEPARTURES:-}" ] || exit 0
departure() {  # NAME OPTIONS...: a step from the paper's form to the shipped one, trained for the same time
    $train -o "$run/$1" --resume --workers 0 "${length[@]}" "${@:2}"
    facerf --checkpoint "$run/$1" evaluate olat "$run/dataset" --network-alone --every 20 -o "$run/tables/$1"
    [ -z "${YALE:-}" ] || facerf --checkpoint "$run/$1" evaluate yale-b "$YALE" --shifts "$SHIFTS" --network-alone \
        --reflectance field \
        ${SUBJECTS:+--subjects "$SUBJECTS"} -o "$run/tables/$1-yale-b"
}
heads=(--heads-from "${HEADS:-builtin}" --heads 60 --bank "$run/bank")
departure geometry --stage joint --form paper "${data[@]}" "${appearance_features[@]}" --geometry landmarks \
    --light-features "$run/light/best.safetensors"
departure loss --stage reflectance --form paper "${data[@]}"
departure data --preset paper --stage reflectance "${heads[@]}"
departure optimizer --form paper "${heads[@]}"
departure architecture "${heads[@]}"
