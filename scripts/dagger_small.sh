#!/usr/bin/env bash
# One round of DAgger on what scripts/reproduce_small.sh has made: where its policy leads, the scripted policy takes over, and the
# policy learns on from those demonstrations and its own. Evaluates the result on all episodes of paper-v1.
#
#   bash scripts/dagger_small.sh pick|search [FOLDER]
#
# FOLDER                  that of reproduce_small.sh (default: reproduced/TASK); what is made goes to FOLDER/dagger
# EPISODES, SEED, STEPS   how many takeovers, the first one's seed, steps of training
# JOBS, ROBOCAS           as in reproduce_small.sh
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/timed.sh

fail() { printf 'dagger_small: error: %s\n' "$*" >&2; exit 2; }

task=${1:-}
[[ $task == pick || $task == search ]] || fail "which task? bash scripts/dagger_small.sh pick|search [FOLDER]"
acts=(5 60)
[[ $task == pick ]] || acts=(5 100) # a search is longer
from=${2:-reproduced/$task}
out=$from/dagger
[[ -f $from/eval/report.md ]] || fail "$from: no run that was trained to its end; bash scripts/reproduce_small.sh $task $from makes it"
episodes=${EPISODES:-300} seed=${SEED:-570000} steps=${STEPS:-1800}
jobs=${JOBS:-$(env -u OMP_NUM_THREADS nproc)}
robocas=${ROBOCAS:-.venv/bin/robocas}

mkdir -p "$out"
timed "$robocas" generate "$task" --config "${task}_upstream_eval" -n "$episodes" --seed "$seed" --jobs "$jobs" \
    --after-policy "$from/run" --after-steps "${acts[@]}" --out "$out/demos"
timed "$robocas" convert "$out/demos/trajectory.h5" --out "$out/parts" --size 512 384 --no-depth --no-video \
    --cameras base_camera gripper_camera --jobs "$jobs"
timed "$robocas" merge "$from/data" "$out/parts" --out "$out/data"
timed "$robocas" train small --data "$out/data" --out "$out/run" --start "$from/run" --steps "$steps"
timed "$robocas" eval "$task" --policy "$out/run" --protocol paper-v1 --out "$out/eval" --envs "$jobs"
