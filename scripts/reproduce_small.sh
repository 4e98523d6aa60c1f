#!/usr/bin/env bash
# Reproduces a result of `small`: records demonstrations, converts them, trains, and evaluates on all episodes of paper-v1.
#
#   bash scripts/reproduce_small.sh pick|select|search [FOLDER]
#
# An interrupted script continues when it is called again. docs/baselines.md has the results.
#
# EPISODES, SEED, STEPS   number of demonstrations (default: 800; search: 920), seed of the first one, training steps
# INIT_FROM               run with the initial weights; `small`: the bundled weights for pick. Default: small for search,
#                         random weights for pick and select; INIT_FROM= for random weights
# JOBS                    processes that record, convert and evaluate (default: one per core)
# ROBOCAS                 robocas command (default: that of the checkout's virtual environment)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/timed.sh

fail() { printf 'reproduce_small: error: %s\n' "$*" >&2; exit 2; }

# Parts of the demonstrations: percent, offset of the seed, task, configuration, policy that acts first. RoboCAS-v0
# evaluates select in the scenes of pick; columns teach to choose among equal objects, but only two kinds of these fruits
# can stand in columns, so the others are scattered. A search ends with a pick from the heap: picks of visible objects are
# faster to record than searches, and perturbed grasps teach recovery.
task=${1:-}
attempts=20 played=pick count=800 steps=3500 init_from=
case $task in
    pick) parts=("100 0 pick pick_upstream_eval") ;;
    select) parts=("30 0 select select_fruits_orderly" "70 0 pick pick_fruits_alike") ;;
    search) # one heap in ten takes half of the time, unless it is skipped early
        parts=("65 0 pick pick_heap" "13 80000 pick pick_heap scripted-perturbed" "22 10000 search search_upstream_eval")
        played=search attempts=3 count=920 steps=3000 init_from=small ;;
    *) fail "invalid task '$task': expected pick, select or search; bash scripts/reproduce_small.sh TASK [FOLDER]" ;;
esac
out=${2:-reproduced/$task}
episodes=${EPISODES:-$count} seed=${SEED:-510000} steps=${STEPS:-$steps} init_from=${INIT_FROM-$init_from}
jobs=${JOBS:-$(env -u OMP_NUM_THREADS nproc)}
robocas=${ROBOCAS:-.venv/bin/robocas}
command -v "$robocas" >/dev/null || fail "$robocas: no such command; install it: bash scripts/setup.sh"

mkdir -p "$out"
settings="EPISODES=$episodes SEED=$seed" # recordings with other settings must not be mixed
[[ -f $out/settings.txt ]] || echo "$settings" >"$out/settings.txt"
[[ $(<"$out/settings.txt") == "$settings" ]] || fail "$out: expected $(<"$out/settings.txt"), found $settings; choose another FOLDER"
data=() left=$episodes
for part in "${parts[@]}"; do
    read -r percent offset of config first <<<"$part"
    count=$((episodes * percent / 100))
    [[ $part != "${parts[-1]}" ]] || count=$left
    left=$((left - count))
    ((count)) || continue
    name=$config${first:+-after-$first}
    timed "$robocas" generate "$of" --config "$config" -n "$count" --seed $((seed + offset)) --jobs "$jobs" \
        --max-attempts "$attempts" ${first:+--after-policy "$first" --after-steps 15 50} --out "$out/demos/$name"
    timed "$robocas" convert "$out/demos/$name/trajectory.h5" --out "$out/parts/$name" --size 512 384 --no-depth --no-video \
        --cameras base_camera gripper_camera --jobs "$jobs"
    data+=("$out/parts/$name")
done
timed "$robocas" merge "${data[@]}" --out "$out/data"
timed "$robocas" train small --data "$out/data" --out "$out/run" --steps "$steps" ${init_from:+--init-from "$init_from"}
timed "$robocas" eval "$played" --policy "$out/run" --protocol paper-v1 --out "$out/eval" --envs "$jobs"
