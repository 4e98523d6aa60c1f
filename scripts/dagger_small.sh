#!/usr/bin/env bash
# Run one round of DAgger after scripts/reproduce_small.sh. The scripted policy acts from states that the trained policy
# reached (expert interventions). The policy is trained on these episodes and the first demonstrations, and evaluated on all
# episodes of paper-v1.
#
#   bash scripts/dagger_small.sh pick|search [FOLDER]
#
# FOLDER         folder of reproduce_small.sh (default: reproduced/TASK); the output is FOLDER/dagger
# EPISODES       number of interventions (default: 300)
# SEED           first seed (default: 570000)
# STEPS          training steps (default: 1800)
# JOBS, ROBOCAS  as in reproduce_small.sh
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/timed.sh

fail() { printf 'dagger_small: error: %s\n' "$*" >&2; exit 2; }
show_usage "$@"
require_numbers STEPS EPISODES JOBS

task=${1:-}
[[ $task == pick || $task == search ]] || fail "invalid task '$task': expected pick or search. Usage: bash scripts/dagger_small.sh TASK [FOLDER]"
steps_before=(5 60)
[[ $task == pick ]] || steps_before=(5 100) # episodes of search are longer
from=${2:-reproduced/$task}
out=$from/dagger
[[ -f $from/eval/report.md ]] || fail "$from: no finished run (missing eval/report.md). Run: bash scripts/reproduce_small.sh $task $from"
episodes=${EPISODES:-300} seed=${SEED:-570000} steps=${STEPS:-1800}
jobs=${JOBS:-$(env -u OMP_NUM_THREADS nproc)}
robocas=${ROBOCAS:-.venv/bin/robocas}

mkdir -p "$out"
timed "$robocas" generate "$task" --config "${task}_upstream_eval" -n "$episodes" --seed "$seed" --jobs "$jobs" \
    --after-policy "$from/run" --after-steps "${steps_before[@]}" --out "$out/demos"
timed "$robocas" convert "$out/demos/trajectory.h5" --out "$out/parts" --size 512 384 --no-depth --no-video \
    --cameras base_camera gripper_camera --jobs "$jobs"
timed "$robocas" merge "$from/data" "$out/parts" --out "$out/data"
timed "$robocas" train small --data "$out/data" --out "$out/run" --init-from "$from/run" --steps "$steps"
timed "$robocas" eval "$task" --policy "$out/run" --protocol paper-v1 --out "$out/eval" --envs "$jobs"
