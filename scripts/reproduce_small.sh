#!/usr/bin/env bash
# From nothing to a score: records demonstrations, converts them, trains `small`, and evaluates it on all episodes of paper-v1.
#
#   bash scripts/reproduce_small.sh pick|select|search [FOLDER]
#
# What is there already is gone on with: an interrupted call is simply made again. docs/baselines.md has what comes out.
#
# EPISODES, SEED, STEPS   how many demonstrations (default: 800), the first one's seed, steps of training
# START                   a run to begin with, or `small`: the weights that come with the package (default: none)
# JOBS                    processes that record, convert and evaluate (default: one a core)
# ROBOCAS                 the command (default: that of the checkout's virtual environment)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

fail() { printf 'reproduce_small: error: %s\n' "$*" >&2; exit 2; }

# Each part is task:configuration:percent of the demonstrations. Upstream evaluates select in pick's scenes; in columns it
# learns to choose among several of a kind, but of these fruits only two stand, so that the others come scattered. A search
# ends in a pick from the heap: what is at hand there is shorter to record than what has to be cleared.
task=${1:-}
attempts=20
case $task in
    pick) parts=(pick:pick_upstream_eval:100) played=pick ;;
    select) parts=(select:select_fruits_orderly:30 pick:pick_fruits_alike:70) played=pick ;;
    search) # one heap in ten takes half of the time, unless it is given up early
        parts=(search:search_upstream_eval:35 pick:pick_heap:65) played=search attempts=3 ;;
    *) fail "which task? bash scripts/reproduce_small.sh pick|select|search [FOLDER]" ;;
esac
out=${2:-reproduced/$task}
episodes=${EPISODES:-800} seed=${SEED:-510000} steps=${STEPS:-3500}
jobs=${JOBS:-$(nproc)}
robocas=${ROBOCAS:-.venv/bin/robocas}
command -v "$robocas" >/dev/null || fail "$robocas: no such command; bash scripts/setup.sh makes it"

timed() {
    local begun=$SECONDS
    "$@"
    printf 'reproduce_small: %s: %d min\n' "$2" $(((SECONDS - begun + 30) / 60))
}

mkdir -p "$out"
data=()
for part in "${parts[@]}"; do
    IFS=: read -r of config percent <<<"$part"
    timed "$robocas" generate "$of" --config "$config" -n $((episodes * percent / 100)) --seed "$seed" --jobs "$jobs" \
        --max-attempts "$attempts" --out "$out/demos/$config" --resume
    timed "$robocas" convert "$out/demos/$config/trajectory.h5" --out "$out/parts/$config" --size 512 384 --no-depth --no-video \
        --cameras base_camera gripper_camera --jobs "$jobs" --resume
    data+=("$out/parts/$config")
done
timed "$robocas" merge "${data[@]}" --out "$out/data" --resume
timed "$robocas" train small --data "$out/data" --out "$out/run" --steps "$steps" ${START:+--start "$START"} --resume
timed "$robocas" eval "$played" --policy "$out/run" --protocol paper-v1 --out "$out/eval" --envs "$jobs" --resume
