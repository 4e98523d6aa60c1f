#!/usr/bin/env bash
# Run a plan of three tasks with images for an hour, with one job per core. Print JSON: time per episode, memory of each
# process over time, and time from Ctrl-C to the end of the plan.
#
#   bash scripts/soak.sh [ARGUMENTS]     # ARGUMENTS of benchmarks/soak.py, for example --minutes 10 --jobs 1
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bin=${ROBOCAS_VENV:-.venv}/bin
export OMP_NUM_THREADS=1
jobs=$(env -u OMP_NUM_THREADS nproc)  # nproc returns OMP_NUM_THREADS if it is set
exec "$bin/python" -W ignore benchmarks/soak.py --jobs "$jobs" "$@"
