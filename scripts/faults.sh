#!/usr/bin/env bash
# Every fault in generation, conversion, plan and evaluation, with real episodes: crashes, endless loops, memory, kill -9 at
# random moments, full disks, ... Prints the fault table in Markdown, also as JSON.
#
#   bash scripts/faults.sh [FOLDER] [PYTEST_ARGUMENTS...]   # faults.md and faults.json go there; default: faults
#
# ROBOCAS_FAULT_KILLS: how often each command is killed (20). ROBOCAS_FAULT_SEED: of the random moments; the table says
# which there was. PYTHON names the interpreter; default: the one scripts/setup.sh made. An hour or more on two cores.
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
"$python" -m pytest -m faults tests/faults -p no:cacheprovider -q "${@:2}" || failed=1
[ -f "$ROBOCAS_FAULT_ROWS" ] || exit 1
"$python" tests/support/fault_table.py "$ROBOCAS_FAULT_ROWS" "$out/faults.json" | tee "$out/faults.md"
exit $failed
