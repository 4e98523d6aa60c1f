#!/usr/bin/env bash
# Check that RoboCAS and LeRobot 0.6 work in one virtual environment, which `setup.sh --lerobot` creates.
#
#   bash scripts/check_lerobot_env.sh
#
# The script runs `pip check`, the tests that need LeRobot or read its datasets, and scripts/check_lerobot_env.py. This
# program runs lerobot-eval with untrained weights of ACT on two tasks of the protocol `smoke`, compares recorded actions of
# the scripted policy in LeRobot's loop with `robocas eval`, and loads an env.py from a cache of the Hub. The first run
# downloads several gigabytes (torch with CUDA libraries). The script needs a renderer (scripts/setup.sh installs one), but
# no GPU and no model hub. It takes about 15 minutes on two cores.
#
# ROBOCAS_LEROBOT_VENV    folder of the environment (default: .venv-lerobot in the checkout). A new folder checks the
#                         installation from scratch.
# ROBOCAS_LEROBOT_PYTHON  Python interpreter that creates the environment (default: python3.12)
set -euo pipefail
[ $# = 0 ] || { echo "usage: bash scripts/check_lerobot_env.sh" >&2; exit 2; }
cd "$(dirname "${BASH_SOURCE[0]}")/.."
test_packages=("pytest>=8.0" "hypothesis>=6.100") needs_renderer=1
. scripts/lerobot_environment.sh
"$venv/bin/python" -m pip --disable-pip-version-check check
export OMP_NUM_THREADS=1
"$venv/bin/python" -m pytest -q -p no:cacheprovider tests/evaluation/harness/test_lerobot_env.py tests/datasets/lerobot
exec "$venv/bin/python" -W ignore scripts/check_lerobot_env.py
