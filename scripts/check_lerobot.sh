#!/usr/bin/env bash
# Check a LeRobot dataset with LeRobot: load the dataset, read frames by index, and iterate over all frames. With LeRobot
# 0.6, also check sub-goals and depth, run lerobot-annotate with a stub server, and run ten steps of lerobot-train.
#
#   bash scripts/check_lerobot.sh [--version 0.6|0.5|2.1] DATASET [ROBOCAS_DATASET]
#
# --version        value of --lerobot-version with which the dataset was converted (default: 0.6). The dataset is read with
#                  LeRobot 0.6.1, 0.5.1 or 0.3.3.
# ROBOCAS_DATASET  RoboCAS folder of the same recordings, with which sub-goals and depth are compared
#
# The check runs in the virtual environment of LeRobot, see lerobot_environment.sh. It downloads nothing from a model hub.
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
