#!/usr/bin/env bash
# Checks that RoboCAS and LeRobot 0.6 work in one environment, starting from an empty one.
#
#   bash scripts/check_lerobot_env.sh
#
# Installs this checkout with the extra lerobot-env into a new environment, runs `pip check`, and then
# scripts/check_lerobot_env.py: lerobot-eval with untrained weights of ACT on two tasks of the protocol `smoke`, recorded
# actions of the demonstrator in LeRobot's loop against `robocas eval`, and an env.py from a cache of the Hub.
# The first run downloads several gigabytes (torch with its CUDA libraries). Needs a renderer (scripts/setup.sh installs
# one) but no GPU, and no model hub. The whole check takes about 15 minutes on two cores.
#
# ROBOCAS_LEROBOT_ENV_VENV    folder of the environment (default: .venv-lerobot-env in the checkout)
# ROBOCAS_LEROBOT_ENV_PYTHON  interpreter to create it with (default: python3.12, the oldest that LeRobot 0.6 supports)
set -euo pipefail
[ $# = 0 ] || { echo "usage: bash scripts/check_lerobot_env.sh" >&2; exit 2; }
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv=${ROBOCAS_LEROBOT_ENV_VENV:-.venv-lerobot-env}
pip=("$venv/bin/python" -m pip --disable-pip-version-check)
stamp=$(cat pyproject.toml lerobot_env_robocas/pyproject.toml | sha256sum)

if [ "$(cat "$venv/.packages" 2>/dev/null)" != "$stamp" ]; then
    echo "environment $venv (minutes the first time)"
    "${ROBOCAS_LEROBOT_ENV_PYTHON:-python3.12}" -m venv --clear "$venv"
    "${pip[@]}" install -qq '.[lerobot-env]' ./lerobot_env_robocas
    echo "$stamp" >"$venv/.packages"
fi
# The requirements are installed; the code may have changed since.
"${pip[@]}" install -qq --force-reinstall --no-deps . ./lerobot_env_robocas
"${pip[@]}" check

export HF_HUB_OFFLINE=1 HF_HOME="$PWD/$venv/hub" OMP_NUM_THREADS=1
case $venv in /*) HF_HOME="$venv/hub" ;; esac
exec "$venv/bin/python" -W ignore scripts/check_lerobot_env.py
