#!/usr/bin/env bash
# Set up, then run the linter, the type checker and all tests.
#
#   bash scripts/test.sh [PYTEST_ARGUMENTS]     # for example: bash scripts/test.sh tests/scenes/config -x
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

bash scripts/setup.sh
bin=$(cd "${ROBOCAS_VENV:-.venv}" && pwd)/bin
"$bin/ruff" check .
"$bin/ruff" format --check .
"$bin/basedpyright" --pythonpath "$bin/python"
unset PYTHONDONTWRITEBYTECODE  # otherwise each of the hundreds of processes of the tests compiles the package again
# Each test process uses one thread: the tensors are small, and threads of several processes compete for cores. There is one
# process more than cores, up to four, because a process waits a fifth of its time for processes that a test has started.
# tests/conftest.py sorts the test files, the longest first, so that no process runs a long file alone at the end.
cores=$(nproc)  # before OMP_NUM_THREADS is set, which nproc takes into account
export OMP_NUM_THREADS=1
"$bin/python" -m pytest -n $((cores < 4 ? cores + 1 : 4)) --dist loadfile --no-loadscope-reorder "$@"
