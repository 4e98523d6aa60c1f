#!/usr/bin/env bash
# Sets up, then lints, checks types and runs every test. Arguments go to pytest: bash scripts/test.sh tests/config -x
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

bash scripts/setup.sh
bin=$(cd "${ROBOCAS_VENV:-.venv}" && pwd)/bin
"$bin/ruff" check .
"$bin/ruff" format --check .
"$bin/basedpyright" --pythonpath "$bin/python"
"$bin/python" -m pytest "$@"
