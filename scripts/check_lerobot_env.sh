#!/usr/bin/env bash
# Checks that RoboCAS and LeRobot 0.6 work in one environment, made by `setup.sh --lerobot`.
#
#   bash scripts/check_lerobot_env.sh
#
# Runs `pip check`, the tests that need LeRobot or read its datasets, and scripts/check_lerobot_env.py: lerobot-eval with
# untrained weights of ACT on two tasks of the protocol `smoke`, recorded actions of the demonstrator in LeRobot's loop against
# `robocas eval`, and an env.py from a cache of the Hub. The first run downloads several gigabytes (torch with its CUDA
# libraries). Needs a renderer (scripts/setup.sh installs one) but no GPU, and no model hub. Takes about 15 minutes on two
# cores.
#
# ROBOCAS_LEROBOT_VENV    folder of the environment (default: .venv-lerobot in the checkout); name one that does not exist
#                         to check the installation from nothing
# ROBOCAS_LEROBOT_PYTHON  interpreter to create it with (default: python3.12)
set -euo pipefail
[ $# = 0 ] || { echo "usage: bash scripts/check_lerobot_env.sh" >&2; exit 2; }
cd "$(dirname "${BASH_SOURCE[0]}")/.."
test_packages=("pytest>=8.0" "hypothesis>=6.100") needs_renderer=1
. scripts/lerobot_environment.sh
"$venv/bin/python" -m pip --disable-pip-version-check check
export OMP_NUM_THREADS=1
"$venv/bin/python" -m pytest -q -p no:cacheprovider tests/evaluation/harness/test_lerobot_env.py tests/datasets/lerobot
exec "$venv/bin/python" -W ignore scripts/check_lerobot_env.py
