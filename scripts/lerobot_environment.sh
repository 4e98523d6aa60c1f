# Sourced by train_lerobot.sh and serve_lerobot.sh, in the checkout's folder: makes LeRobot's environment, sets $venv.
# It is check_lerobot.sh's own, with what talks over the policy socket besides; both may be used in turn.
#
# ROBOCAS_LEROBOT_VENV    folder of that environment (default: .venv-lerobot in the checkout)
# ROBOCAS_LEROBOT_PYTHON  interpreter to make it with (default: python3.11)

packages=(lerobot==0.4.4 torch==2.10.0 torchvision==0.25.0) # as check_lerobot.sh has them, and why
socket=("msgpack>=1.0.5" "websockets>=15" "pydantic>=2" scipy PyYAML platformdirs)
venv=${ROBOCAS_LEROBOT_VENV:-.venv-lerobot}

if [ "$(cat "$venv/.packages" 2>/dev/null)" != "${packages[*]}" ]; then
    echo "environment $venv: ${packages[*]} (minutes and gigabytes the first time)"
    "${ROBOCAS_LEROBOT_PYTHON:-python3.11}" -m venv --clear "$venv"
    "$venv/bin/python" -m pip --disable-pip-version-check install -qq "${packages[@]}"
    echo "${packages[*]}" >"$venv/.packages"
fi
if [ "$(cat "$venv/.socket" 2>/dev/null)" != "${socket[*]}" ]; then
    "$venv/bin/python" -m pip --disable-pip-version-check install -qq "${socket[@]}"
    echo "${socket[*]}" >"$venv/.socket"
fi
venv=$(cd "$venv" && pwd)
export HF_HUB_OFFLINE=${HF_HUB_OFFLINE:-1} HF_HOME=${HF_HOME:-$venv/hub} # tables are cached there; nothing is downloaded
