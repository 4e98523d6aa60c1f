#!/usr/bin/env bash
# Evaluates policies with LeRobot's own lerobot-eval in our environments: lerobot_env_robocas, in an environment of its own.
#
#   bash scripts/check_lerobot_env.sh
#
# Plays episodes of the protocol `smoke`: untrained weights of ACT by the command, and recorded motions of the
# demonstrator by LeRobot's loop, which must come out as `robocas eval` has them. Needs scripts/setup.sh to have run.
# The first run downloads gigabytes (torch with its CUDA libraries); no GPU is needed, nothing is fetched from a model hub.
#
# ROBOCAS_SIM_PYTHON              interpreter that has robocas_ms3 (default: .venv's in the checkout)
# ROBOCAS_LEROBOT_ENV_VENV    folder of LeRobot's environment (default: .venv-lerobot-env in the checkout)
# ROBOCAS_LEROBOT_ENV_PYTHON  interpreter to make it with (default: python3.12, the oldest that lerobot 0.6 takes)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# 0.6 is the first LeRobot that looks for lerobot_env_*. It takes numpy 2.0 to 2.2, torch < 2.12 and torchvision < 0.27.
PACKAGES=("lerobot[dataset,evaluation]==0.6.1" torch==2.11.0 torchvision==0.26.0)
venv=${ROBOCAS_LEROBOT_ENV_VENV:-.venv-lerobot-env}
stamp="${PACKAGES[*]}"

if [ "$(cat "$venv/.packages" 2>/dev/null)" != "$stamp" ]; then
    echo "environment $venv: ${PACKAGES[*]} (minutes the first time)"
    "${ROBOCAS_LEROBOT_ENV_PYTHON:-python3.12}" -m venv --clear "$venv"
    "$venv/bin/python" -m pip --disable-pip-version-check install -qq "${PACKAGES[@]}" ./lerobot_env_robocas
    echo "$stamp" >"$venv/.packages"
fi
# What it needs is there; its code may be another than last time.
"$venv/bin/python" -m pip --disable-pip-version-check install -qq --force-reinstall --no-deps ./lerobot_env_robocas
export ROBOCAS_SIM_PYTHON=${ROBOCAS_SIM_PYTHON:-$PWD/.venv/bin/python}
export HF_HUB_OFFLINE=1 HF_HOME="$venv/hub"
exec "$venv/bin/python" -W ignore scripts/check_lerobot_env.py
