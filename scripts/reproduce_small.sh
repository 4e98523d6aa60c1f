#!/usr/bin/env bash
# From nothing to a score: records demonstrations, converts them, trains `small`, and evaluates it on all episodes of paper-v1.
#
#   bash scripts/reproduce_small.sh pick|select|search [FOLDER]
#
# What is there already is gone on with: an interrupted call is simply made again. docs/baselines.md has what comes out.
#
# EPISODES, SEED, STEPS   how many demonstrations (default: 800; of search 920), the first one's seed, steps of training
# START                   a run to begin with; `small` are the weights of pick that come with the package. Default of search, of
#                         the others none; START= for none
# JOBS                    processes that record, convert and evaluate (default: one a core)
# ROBOCAS                 the command (default: that of the checkout's virtual environment)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/timed.sh

fail() { printf 'reproduce_small: error: %s\n' "$*" >&2; exit 2; }

# Parts of the demonstrations: percent, first seed, task, configuration, and who acts first. Upstream evaluates select in
# pick's scenes; in columns it learns to choose among several of a kind, but of these fruits only two stand, so that the
# others come scattered. A search ends in a pick from the heap: what is at hand there is shorter to record than what has
# to be cleared, and fumbles in a heap are what it has to get out of.
task=${1:-}
attempts=20 played=pick count=800 steps=3500 start=
case $task in
    pick) parts=("100 0 pick pick_upstream_eval") ;;
    select) parts=("30 0 select select_fruits_orderly" "70 0 pick pick_fruits_alike") ;;
    search) # one heap in ten takes half of the time, unless it is given up early
        parts=("65 0 pick pick_heap" "13 80000 pick pick_heap scripted-perturbed" "22 10000 search search_upstream_eval")
        played=search attempts=3 count=920 steps=3000 start=small ;;
    *) fail "which task? bash scripts/reproduce_small.sh pick|select|search [FOLDER]" ;;
esac
out=${2:-reproduced/$task}
episodes=${EPISODES:-$count} seed=${SEED:-510000} steps=${STEPS:-$steps} start=${START-$start}
jobs=${JOBS:-$(env -u OMP_NUM_THREADS nproc)}
robocas=${ROBOCAS:-.venv/bin/robocas}
command -v "$robocas" >/dev/null || fail "$robocas: no such command; bash scripts/setup.sh makes it"

mkdir -p "$out"
asked="EPISODES=$episodes SEED=$seed" # else what is there would be mixed with what comes
[[ -f $out/asked ]] || echo "$asked" >"$out/asked"
[[ $(<"$out/asked") == "$asked" ]] || fail "$out was begun with $(<"$out/asked"), not $asked: name another FOLDER"
data=() left=$episodes
for part in "${parts[@]}"; do
    read -r percent offset of config first <<<"$part"
    share=$((episodes * percent / 100))
    [[ $part != "${parts[-1]}" ]] || share=$left
    left=$((left - share))
    ((share)) || continue
    name=$config${first:+-after-$first}
    timed "$robocas" generate "$of" --config "$config" -n "$share" --seed $((seed + offset)) --jobs "$jobs" \
        --max-attempts "$attempts" ${first:+--after-policy "$first" --after-steps 15 50} --out "$out/demos/$name"
    timed "$robocas" convert "$out/demos/$name/trajectory.h5" --out "$out/parts/$name" --size 512 384 --no-depth --no-video \
        --cameras base_camera gripper_camera --jobs "$jobs"
    data+=("$out/parts/$name")
done
timed "$robocas" merge "${data[@]}" --out "$out/data"
timed "$robocas" train small --data "$out/data" --out "$out/run" --steps "$steps" ${start:+--start "$start"}
timed "$robocas" eval "$played" --policy "$out/run" --protocol paper-v1 --out "$out/eval" --envs "$jobs"
