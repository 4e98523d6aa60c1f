#!/usr/bin/env bash
# An hour of a plan on this machine, all three tasks with images, a job a core: what an episode costs, whether processes
# grow, how fast Ctrl-C ends it. Prints JSON. Arguments go to benchmarks/soak.py: bash scripts/soak.sh --minutes 10 --jobs 1
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bin=${ROBOCAS_VENV:-.venv}/bin
export OMP_NUM_THREADS=1
jobs=$(env -u OMP_NUM_THREADS nproc)  # which would count those
exec "$bin/python" -W ignore benchmarks/soak.py --jobs "$jobs" "$@"
