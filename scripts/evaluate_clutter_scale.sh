#!/usr/bin/env bash
# Evaluate policies on clutter-scale-v1, and place them on the clutter scale (docs/difficulty.md).
#
#   bash scripts/evaluate_clutter_scale.sh [POLICY[:MM:DEG] ...]
#
# POLICY   a name of `robocas list`, or a run folder of `robocas train`; with :MM:DEG, action noise with these standard deviations
#          (default: variants of the scripted policy, keyframe, keyframe-upstream and small-ms3)
#
# At least two policies with 10 to 90 % success are necessary for the scale.
# After an interruption, run the script again to continue. Results: OUT/POLICY; the clutter scale of all results in OUT: OUT/scale.
#
# EPISODES  number of episodes to evaluate of each configuration (default: all)
# OUT       folder of the results (default: reproduced/clutter_scale)
# JOBS      number of processes that evaluate (default: one per core)
# ROBOCAS   robocas command (default: .venv/bin/robocas)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/timed.sh
source scripts/shards.sh

fail() { printf 'evaluate_clutter_scale: error: %s\n' "$*" >&2; exit 2; }
show_usage "$@"
require_numbers EPISODES JOBS
policies=("$@")
((${#policies[@]})) || policies=(
    scripted-lookahead-0 scripted-lookahead-1 scripted-lookahead-2 scripted-lookahead-8 scripted-ee-delta:15:6 scripted-ee-delta:20:8
    scripted-ee-delta:35:14 keyframe keyframe-upstream small-ms3)
out=${OUT:-reproduced/clutter_scale}
jobs=${JOBS:-$(env -u OMP_NUM_THREADS nproc)}
robocas=${ROBOCAS:-.venv/bin/robocas}
command -v "$robocas" >/dev/null || fail "no such command: $robocas. Run bash scripts/setup.sh, or set ROBOCAS."

for entry in "${policies[@]}"; do
    IFS=: read -r policy mm deg <<<"$entry"
    evaluate "$out/${entry//[:\/]/_}" --policy "$policy" --protocol clutter-scale-v1 ${mm:+--action-noise "$mm" "$deg"} \
        ${EPISODES:+--episodes "$EPISODES"}
done
results=("$out"/*/run.json)
"$robocas" eval clutter-scale "${results[@]%/run.json}" --out "$out/scale"
