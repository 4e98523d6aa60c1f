#!/usr/bin/env bash
# What demonstrations, words and cameras are worth to `small`: trains it on parts of what `scripts/reproduce_small.sh pick` has
# made, or on all of it without language or without a camera, for as many steps each, and evaluates it on paper-v1.
#
#   bash scripts/study_small.sh [FOLDER [WHAT ...]]
#
# FOLDER                  that of reproduce_small.sh (default: reproduced/pick); what is made goes to FOLDER/study/WHAT
# WHAT                    50, 200 or another number of demonstrations; all; no-language; no-gripper-camera (default: all of these)
# STEPS, EPISODES         steps of training (default: 1500), episodes of paper-v1 to evaluate on (default: 200, which are all)
# JOBS, ROBOCAS           as in reproduce_small.sh
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/timed.sh

fail() { printf 'study_small: error: %s\n' "$*" >&2; exit 2; }

from=${1:-reproduced/pick}
whats=("${@:2}")
((${#whats[@]})) || whats=(50 200 all no-language no-gripper-camera)
steps=${STEPS:-1500} episodes=${EPISODES:-200} jobs=${JOBS:-$(env -u OMP_NUM_THREADS nproc)}
robocas=${ROBOCAS:-.venv/bin/robocas}
made=$from/data
[[ -f $made/data_info.json ]] || fail "$from: no data; bash scripts/reproduce_small.sh pick $from makes it"
count=$(find "$made" -maxdepth 1 -name 'episode_*' | wc -l)

for what in "${whats[@]}"; do  # before hours go by
    case $what in
        all | no-language | no-gripper-camera) ;;
        *[!0-9]* | 0*) fail "$what: neither a number of demonstrations nor all, no-language or no-gripper-camera" ;;
        *) ((what < count)) || fail "$what: $made has $count demonstrations" ;;
    esac
done

for what in "${whats[@]}"; do
    data=$made out=$from/study/$what more=()
    case $what in
        all) ;;
        no-language) more=(--set language=false) ;;
        no-gripper-camera) more=(--set views.gripper_camera=null) ;;
        *)
            data=$out/data/part_0
            read -r share rest < <(awk -v part="$what" -v all="$count" 'BEGIN { printf "%.9f %.9f\n", part / all, 1 - part / all }')
            timed "$robocas" split "$made" --fractions "$share" "$rest" --out "$out/data"
            ;;
    esac
    timed "$robocas" train small --data "$data" --out "$out/run" --steps "$steps" "${more[@]}"
    timed "$robocas" eval pick --policy "$out/run" --protocol paper-v1 --episodes "$episodes" --out "$out/eval" --envs "$jobs"
done
