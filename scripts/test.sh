#!/usr/bin/env bash
# Sets up, then lints, checks types and runs every test. Arguments go to pytest: bash scripts/test.sh tests/config -x
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

bash scripts/setup.sh
bin=$(cd "${ROBOCAS_VENV:-.venv}" && pwd)/bin
"$bin/ruff" check .
"$bin/ruff" format --check .
"$bin/basedpyright" --pythonpath "$bin/python"
# A process a core, with one thread each: the tensors are small, and threads of several processes get in each other's way.
# Files in order: else those with few tests, which are the slow ones, come last, and one process waits for the other.
export OMP_NUM_THREADS=1
"$bin/python" -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder "$@"
