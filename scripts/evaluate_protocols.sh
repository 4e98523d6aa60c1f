#!/usr/bin/env bash
# Evaluate a policy on all bundled protocols, and add its rows to the table of results.
#
#   bash scripts/evaluate_protocols.sh POLICY [PROTOCOL ...]
#
# POLICY    a name of `robocas list`, a run folder of `robocas train`, or a folder with one run per task (FOLDER/pick, ...)
# PROTOCOL  names of protocols (default: all but smoke, removal-order-v1, and clutter-scale-v1, see evaluate_clutter_scale.sh)
#
# After an interruption, run the script again to continue. Results: OUT/POLICY/PROTOCOL, with _ in place of / in POLICY. With
# one run per task: OUT/POLICY/PROTOCOL/TASK; tasks without a run are left out. In paper-v1, select has the episodes of pick.
#
# SPLIT        only the episodes of this split; protocols without it are left out. A policy that observes neither images nor instructions needs only SPLIT=seen in
#              looks-v1, cameras-v1, instructions-v1 and paper-words-v1: the scenes of all splits are the same.
# EPISODES     number of episodes to evaluate of each configuration (default: all)
# OUT          folder of the results (default: reproduced/protocols)
# TABLE        file of the table of results (default: docs/results/results.json)
# JOBS         number of processes that evaluate (default: one per core)
# ROBOCAS      robocas command (default: .venv/bin/robocas)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/timed.sh
source scripts/shards.sh

fail() { printf 'evaluate_protocols: error: %s\n' "$*" >&2; exit 2; }
show_usage "$@"
require_numbers EPISODES JOBS

policy=${1:-}
[[ -n $policy ]] || fail "missing policy. Usage: bash scripts/evaluate_protocols.sh POLICY [PROTOCOL ...]"
protocols=("${@:2}")
((${#protocols[@]})) || protocols=(
    ms3-v1 paper-v1 paper-words-v1 objects-v1 clutter-v1 arrangement-v1 looks-v1 cameras-v1 furniture-v1 instructions-v1)
subset=(${SPLIT:+--split "$SPLIT"} ${EPISODES:+--episodes "$EPISODES"})
out=${OUT:-reproduced/protocols} table=${TABLE:-docs/results/results.json}
jobs=${JOBS:-$(env -u OMP_NUM_THREADS nproc)}
robocas=${ROBOCAS:-.venv/bin/robocas}
command -v "$robocas" >/dev/null || fail "no such command: $robocas. Run bash scripts/setup.sh, or set ROBOCAS."

has_task() {
    local played=$2
    [[ $1 == paper-v1 && $2 == select ]] && played=pick
    grep -q "\"task\":\"$played\"" "robocas_ms3/data/protocols/$1/episodes.jsonl"
}

has_split() {
    [[ -z ${SPLIT:-} ]] || grep -q "\"split\":\"$SPLIT\"" "robocas_ms3/data/protocols/$1/episodes.jsonl"
}

add_rows() {
    mkdir -p "$(dirname "$table")"
    "$robocas" eval table "$1" --update --out "$table" >/dev/null
}

runs=("$policy"/{pick,select,search,open_pick}/run.json)
for run in "${runs[@]}"; do
    [[ ! -e $run ]] || per_task=1
done
for protocol in "${protocols[@]}"; do
    folder=$out/${policy//\//_}/$protocol
    has_split "$protocol" || continue
    if [[ ${per_task:-} ]]; then
        for task in pick select search open_pick; do
            [[ -e $policy/$task/run.json ]] || continue
            has_task "$protocol" "$task" || continue
            evaluate "$folder/$task" "$task" --policy "$policy/$task" --protocol "$protocol" "${subset[@]}"
            add_rows "$folder/$task"
        done
    else
        evaluate "$folder" --policy "$policy" --protocol "$protocol" "${subset[@]}"
        add_rows "$folder"
    fi
done
