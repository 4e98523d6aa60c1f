#!/usr/bin/env bash
# Run an ablation study of `small` after `scripts/reproduce_small.sh pick`: train on subsets of the demonstrations, or on all
# demonstrations without language or without the gripper camera, and evaluate on paper-v1. All runs have equal steps.
#
#   bash scripts/study_small.sh [FOLDER [VARIANT ...]]
#
# FOLDER                  folder of reproduce_small.sh (default: reproduced/pick); output: FOLDER/study/VARIANT
# VARIANT                 a number of demonstrations, all, no-language or no-gripper-camera (default: the five variants
#                         50 200 all no-language no-gripper-camera)
# STEPS, EPISODES         training steps (default: 1500), episodes of paper-v1 to evaluate (default: 200, all)
# JOBS, ROBOCAS           as in reproduce_small.sh
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/timed.sh

fail() { printf 'study_small: error: %s\n' "$*" >&2; exit 2; }
show_usage "$@"
require_numbers STEPS EPISODES JOBS

from=${1:-reproduced/pick}
variants=("${@:2}")
((${#variants[@]})) || variants=(50 200 all no-language no-gripper-camera)
steps=${STEPS:-1500} episodes=${EPISODES:-200} jobs=${JOBS:-$(env -u OMP_NUM_THREADS nproc)}
robocas=${ROBOCAS:-.venv/bin/robocas}
dataset=$from/data
[[ -f $dataset/data_info.json ]] || fail "$from: no dataset. Run: bash scripts/reproduce_small.sh pick $from"
count=$(find "$dataset" -maxdepth 1 -name 'episode_*' | wc -l)

for variant in "${variants[@]}"; do  # check all before the first training
    case $variant in
        all | no-language | no-gripper-camera) ;;
        *[!0-9]* | 0*) fail "invalid variant '$variant': expected a number of demonstrations, all, no-language or no-gripper-camera" ;;
        *) ((variant < count)) || fail "invalid variant '$variant': expected a number below $count, the number of demonstrations in $dataset" ;;
    esac
done

for variant in "${variants[@]}"; do
    data=$dataset out=$from/study/$variant options=()
    case $variant in
        all) ;;
        no-language) options=(--set language=false) ;;
        no-gripper-camera) options=(--set views.gripper_camera=null) ;;
        *)
            data=$out/data/part_0
            read -r fraction rest < <(awk -v part="$variant" -v all="$count" 'BEGIN { printf "%.9f %.9f\n", part / all, 1 - part / all }')
            timed "$robocas" split "$dataset" --fractions "$fraction" "$rest" --out "$out/data"
            ;;
    esac
    timed "$robocas" train small --data "$data" --out "$out/run" --steps "$steps" "${options[@]}"
    timed "$robocas" eval pick --policy "$out/run" --protocol paper-v1 --episodes "$episodes" --out "$out/eval" --envs "$jobs"
done
