#!/usr/bin/env bash
# Loads a LeRobot dataset with LeRobot itself: index, iterate, read depth, train two steps of ACT and of diffusion policy.
#
#   bash scripts/check_lerobot.sh DATASET
#
# LeRobot gets an environment of its own: it wants a torch with its torchvision, and numpy 2. The first run downloads
# gigabytes (torch with its CUDA libraries); no GPU is needed, and nothing is fetched from a model hub.
#
# ROBOCAS_LEROBOT_VENV    folder of that environment (default: .venv-lerobot in the checkout)
# ROBOCAS_LEROBOT_PYTHON  interpreter to make it with (default: python3.11, the newest that lerobot 0.4 is tried with here)
set -euo pipefail

[ $# = 1 ] && [ -f "$1/meta/info.json" ] || { echo "usage: bash scripts/check_lerobot.sh DATASET" >&2; exit 2; }
dataset=$(cd "$1" && pwd)
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# 0.4.4 takes torch < 2.11 and torchvision < 0.26. torchvision 0.25 still has the PyAV reader that LeRobot's `pyav` backend
# uses; its other backend, torchcodec, wants FFmpeg's libraries on the machine.
PACKAGES=(lerobot==0.4.4 torch==2.10.0 torchvision==0.25.0)
venv=${ROBOCAS_LEROBOT_VENV:-.venv-lerobot}
stamp="${PACKAGES[*]}"

if [ "$(cat "$venv/.packages" 2>/dev/null)" != "$stamp" ]; then
    echo "environment $venv: ${PACKAGES[*]} (minutes the first time)"
    "${ROBOCAS_LEROBOT_PYTHON:-python3.11}" -m venv --clear "$venv"
    "$venv/bin/python" -m pip --disable-pip-version-check install -qq "${PACKAGES[@]}"
    echo "$stamp" >"$venv/.packages"
fi
export HF_HUB_OFFLINE=1 HF_HOME="$venv/hub" # caches its tables there, never downloads
exec "$venv/bin/python" -W ignore scripts/check_lerobot.py "$dataset"
