#!/usr/bin/env bash
# What other packages make of ours: vla-eval plays our episodes, and says what `robocas eval` says of the same policy;
# robostats computes our intervals and tests.
#
#   bash scripts/check_others.sh
#
# These are no dependencies, not even of the tests, so they get an environment of their own with this checkout in it.
# Needs a render device (scripts/setup.sh installs one) and a few minutes.
#
# ROBOCAS_OTHERS_VENV    folder of that environment (default: .venv-others in the checkout)
# ROBOCAS_OTHERS_PYTHON  interpreter to make it with (default: python3.11; robostats takes none before)
set -euo pipefail
[ $# = 0 ] || { echo "usage: bash scripts/check_others.sh" >&2; exit 2; }
cd "$(dirname "${BASH_SOURCE[0]}")/.."

PACKAGES=(vla-eval==0.8.0 robostats==0.2.0)
venv=${ROBOCAS_OTHERS_VENV:-.venv-others}
stamp="${PACKAGES[*]} $(cat pyproject.toml requirements.lock | sha256sum) $PWD"

if [ "$(cat "$venv/.packages" 2>/dev/null)" != "$stamp" ]; then
    echo "environment $venv: ${PACKAGES[*]} (minutes the first time)"
    "${ROBOCAS_OTHERS_PYTHON:-python3.11}" -m venv --clear "$venv"
    pip=("$venv/bin/python" -m pip --disable-pip-version-check install -qq -c requirements.lock)
    "${pip[@]}" torch==2.13.0 # first and by itself: a CPU build where one is at hand
    "${pip[@]}" -e '.[remote]' pytest hypothesis "${PACKAGES[@]}"
    echo "$stamp" >"$venv/.packages"
fi
export OMP_NUM_THREADS=1
"$venv/bin/python" -W ignore scripts/check_vla_eval.py
"$venv/bin/python" -m pytest -q tests/evaluation/test_statistics.py -k another_package -W error::pytest.PytestWarning \
    -o addopts= -rs | tee "$venv/robostats.txt"
! grep -q skipped "$venv/robostats.txt" || { echo "robostats was not asked" >&2; exit 1; }
