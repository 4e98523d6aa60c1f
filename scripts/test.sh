#!/usr/bin/env bash
# Sets up, then lints, checks types and runs every test. Arguments go to pytest: bash scripts/test.sh tests/scenes/config -x
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

bash scripts/setup.sh
bin=$(cd "${ROBOCAS_VENV:-.venv}" && pwd)/bin
"$bin/ruff" check .
"$bin/ruff" format --check .
"$bin/basedpyright" --pythonpath "$bin/python"
unset PYTHONDONTWRITEBYTECODE  # else each of the hundreds of processes that tests start compiles the package anew
# Processes of one thread: the tensors are small, and threads of several processes get in each other's way. One more than
# there are cores, up to four: a fifth of a process's time goes by waiting for others that a test has started.
# Files in our order (tests/conftest.py, the longest first): else a long one comes last, and one process waits for it.
cores=$(nproc)  # before the next line, which nproc heeds
export OMP_NUM_THREADS=1
"$bin/python" -m pytest -n $((cores < 4 ? cores + 1 : 4)) --dist loadfile --no-loadscope-reorder "$@"
