#!/usr/bin/env bash
# Sets up everything the project needs; safe to run again (a second or so when there is nothing to do).
#
#   bash scripts/setup.sh
#
# ROBOCAS_VENV            folder of the virtual environment (default: .venv in the checkout)
# ROBOCAS_PYTHON          interpreter to make it with (default: the first of python3.11, 3.12, 3.10, python3 that fits)
# ROBOCAS_SKIP_RENDERER=1 leave rendering as it is
# ROBOCAS_SKIP_BROWSER=1  install no Chromium for the tests of robocas view
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

TORCH=torch==2.13.0
venv=${ROBOCAS_VENV:-.venv}
python=$venv/bin/python
stamp_file=$venv/.robocas-setup

say() { printf 'setup: %s\n' "$*"; }
fail() { printf 'setup: error: %s\n' "$*" >&2; exit 1; }

fits() { "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 13))' 2>/dev/null; }

find_python() {
    local candidate
    for candidate in ${ROBOCAS_PYTHON:-python3.11 python3.12 python3.10 python3 python}; do
        if fits "$candidate"; then
            command -v "$candidate"
            return
        fi
    done
    fail "no Python 3.10, 3.11 or 3.12 found (numpy < 2 has no builds for newer ones)." \
        "Install one, or name it: ROBOCAS_PYTHON=/path/to/python3.11 bash scripts/setup.sh"
}

make_venv() {
    local base
    base=$(find_python)
    say "virtual environment $venv, $("$base" --version)"
    if "$base" -m venv --clear "$venv" >/dev/null 2>&1; then return; fi
    # Debian and Ubuntu keep ensurepip in a package of its own.
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        say "installing python3-venv"
        apt-get update -qq >/dev/null 2>&1 || true
        DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends python3-venv >/dev/null 2>&1 || true
        if "$base" -m venv --clear "$venv" >/dev/null 2>&1; then return; fi
    fi
    fail "$base can't make a virtual environment. Install its venv module (Debian, Ubuntu: apt-get install python3-venv)."
}

install_packages() {
    local pip=("$python" -m pip --disable-pip-version-check install --quiet)
    say "packages, at the versions of requirements.lock (minutes the first time)"
    "${pip[@]}" --upgrade 'pip>=24'
    # torch first and by itself: a CPU build where one is at hand satisfies it, and nothing later replaces it.
    "${pip[@]}" -c requirements.lock "$TORCH"
    "${pip[@]}" -c requirements.lock hatchling editables
    "${pip[@]}" -c requirements.lock --no-build-isolation -e '.[dev]'
    # opencv-python wants libGL, which a machine without a desktop lacks; the headless build of the same version does not.
    if ! "$python" -c 'import cv2' 2>/dev/null; then
        "${pip[@]}" --no-deps --force-reinstall \
            "opencv-python-headless==$("$python" -c 'from importlib.metadata import version; print(version("opencv-python"))')"
        "$python" -c 'import cv2' || fail "OpenCV can't be imported; the line above says what it lacks."
    fi
}

stamp=$({ pwd; cat pyproject.toml requirements.lock scripts/setup.sh; } | sha256sum | cut -d ' ' -f 1)
if [ "$(cat "$stamp_file" 2>/dev/null)" != "$stamp" ] || ! fits "$python"; then
    rm -f "$stamp_file"
    fits "$python" || make_venv
    install_packages
    echo "$stamp" >"$stamp_file"
    say "done: $venv/bin/robocas"
fi

if [ "${ROBOCAS_SKIP_RENDERER:-0}" != 1 ]; then
    ROBOCAS_SETUP_PYTHON=$python bash scripts/install_renderer.sh
fi
if [ "${ROBOCAS_SKIP_BROWSER:-0}" != 1 ]; then
    ROBOCAS_SETUP_PYTHON=$python bash scripts/install_browser.sh
fi
