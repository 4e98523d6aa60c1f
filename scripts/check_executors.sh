#!/usr/bin/env bash
# Run one plan of pick episodes with images on each executor: local, Slurm, a Ray cluster of two nodes on this machine, and
# this cluster with files that the driver gathers. Compare the files of all runs byte by byte, and print a table. The exit
# status is 1 if files differ. --kill repeats each run, and kills the processes of a job, or a node, during the run.
#
#     bash scripts/check_executors.sh [--episodes 40] [--seed 0] [--jobs 2] [--kill] [--out FOLDER]
#
# If no Slurm is running, scripts/slurm_here.sh starts one and stops it at the end (as root, on Debian or Ubuntu). If this
# fails, submitit runs the jobs as local processes, and the table says so. --out FOLDER keeps the files of the runs. A Slurm
# cluster of several machines needs a folder that all machines share. The script needs a render device.
#
# ROBOCAS_EXECUTORS_VENV  existing virtual environment with the extras slurm and ray (default: scripts/setup.sh creates one
#                         in a temporary folder, which takes minutes and gigabytes, and is deleted at the end)
set -euo pipefail
for word in "$@"; do
    case $word in
        -h | --help) sed -n '2,/^set/{s/^# \{0,1\}//;/^set/d;p}' "${BASH_SOURCE[0]}" && exit ;;
    esac
done
here=$PWD
cd "$(dirname "${BASH_SOURCE[0]}")/.."
say() { printf 'executors: %s\n' "$*"; }

made=""
slurm_is_ours=0
clean_up() {
    if [ "$slurm_is_ours" = 1 ]; then bash scripts/slurm_here.sh stop || true; fi
    if [ -n "$made" ]; then rm -rf "$made"; fi
}
trap clean_up EXIT
trap 'exit 130' INT TERM

venv=${ROBOCAS_EXECUTORS_VENV:-}
if [ -z "$venv" ]; then
    made=$(mktemp -d)
    venv=$made/venv
    ROBOCAS_VENV=$venv ROBOCAS_SKIP_BROWSER=1 bash scripts/setup.sh
    say "installing the extras slurm and ray"
    "$venv/bin/python" -m pip --disable-pip-version-check install -qq -c requirements.lock --no-build-isolation -e '.[slurm,ray]'
else
    [ "${venv#/}" != "$venv" ] || venv=$here/$venv
fi
python=$venv/bin/python
"$python" -c 'import ray, submitit' || { say "$venv has no ray or no submitit. Run: $python -m pip install -e '.[slurm,ray]'" >&2; exit 2; }

if ! timeout 10 sinfo --noheader >/dev/null 2>&1; then
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null && bash scripts/slurm_here.sh; then
        slurm_is_ours=1
    else
        say "Slurm cannot be started on this machine, so submitit runs the jobs as local processes"
    fi
fi

export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" PYTHONWARNINGS=ignore OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
"$python" scripts/check_executors.py --from "$here" "$@"
