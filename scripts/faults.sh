#!/usr/bin/env bash
# Inject faults into generate, convert, plan run and eval with real episodes: crashes, endless loops, exhausted memory,
# kill -9 at random times, full disks. Print a Markdown table of the faults and their outcomes.
#
#   bash scripts/faults.sh [FOLDER] [PYTEST_ARGUMENTS...]   # writes faults.md and faults.json to FOLDER (default: faults)
#
# ROBOCAS_FAULT_KILLS  number of times that each command is killed (default: 20)
# ROBOCAS_FAULT_SEED   seed of the random times (default: random); the table contains the seed
# PYTHON               Python interpreter (default: .venv/bin/python, which scripts/setup.sh creates)
#
# The script takes an hour or more on two cores.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=${PYTHON:-.venv/bin/python}
out=${1:-faults}
mkdir -p "$out"
out=$(realpath "$out")
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" OMP_NUM_THREADS=1 PYTHONWARNINGS=ignore
export ROBOCAS_FAULT_ROWS="$out/rows.jsonl"
rm -f "$ROBOCAS_FAULT_ROWS"
failed=0
"$python" -m pytest -m faults tests/faults -o timeout=0 -p no:cacheprovider -q "${@:2}" || failed=1
[ -f "$ROBOCAS_FAULT_ROWS" ] || exit 1
"$python" tests/support/fault_table.py "$ROBOCAS_FAULT_ROWS" "$out/faults.json" | tee "$out/faults.md"
exit $failed
