#!/usr/bin/env bash
# Checks a LeRobot dataset with LeRobot itself: loads it, indexes and iterates it. With LeRobot 0.6 also: sub-goal and depth
# of frames, lerobot-annotate against a stub server, ten steps of lerobot-train.
#
#   bash scripts/check_lerobot.sh [--version 0.6|0.5|2.1] DATASET [ROBOCAS_DATASET]
#
# --version        the --lerobot-version that the dataset was converted with (default: 0.6); it names the LeRobot that reads
#                  it: 0.6.1, 0.5.1 or 0.3.3
# ROBOCAS_DATASET  RoboCAS folder of the same recordings: sub-goals and depth are compared with it
#
# Runs in LeRobot's environment, see lerobot_environment.sh. Nothing is fetched from a model hub.
set -euo pipefail

usage() { sed -n '5p' "$0" >&2; exit 2; }
lerobot_version=0.6
if [ "${1:-}" = --version ]; then
    [ $# -ge 2 ] || usage
    lerobot_version=$2
    shift 2
fi
{ [ $# = 1 ] || [ $# = 2 ]; } && [ -f "$1/meta/info.json" ] || usage
paths=()
for path in "$@"; do paths+=("$(cd "$path" && pwd)"); done
cd "$(dirname "${BASH_SOURCE[0]}")/.."
test_packages=("openai>=1.40,<2") # lerobot-annotate imports it, and LeRobot does not install it
. scripts/lerobot_environment.sh
exec "$venv/bin/python" -W ignore scripts/check_lerobot.py "${paths[@]}"
