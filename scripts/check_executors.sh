#!/usr/bin/env bash
# One plan of pick episodes with images by each executor: this machine, Slurm, a Ray cluster of two nodes on this machine, the
# same with files gathered by the driver. Compares all that the runs made byte for byte, prints a table, ends with 1 on any
# difference. With --kill each also runs while the processes of a job, or a node, are killed.
#
#     bash scripts/check_executors.sh [--episodes 40] [--seed 0] [--jobs 2] [--kill] [--out FOLDER]
#
# Where no Slurm answers, scripts/slurm_here.sh starts one for as long as this takes (root; Debian, Ubuntu); where that can't
# be, jobs are processes that submitit starts, and the table says so. FOLDER keeps what was made; a Slurm of several
# machines needs one that all of them see. Needs a render device.
#
# ROBOCAS_EXECUTORS_VENV  environment to use as it is, with the extras slurm and ray (default: one is made by scripts/setup.sh in
#                       a temporary folder, which takes minutes and gigabytes, and deleted in the end)
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
    say "the extras slurm and ray"
    "$venv/bin/python" -m pip --disable-pip-version-check install -qq -c requirements.lock --no-build-isolation -e '.[slurm,ray]'
else
    [ "${venv#/}" != "$venv" ] || venv=$here/$venv
fi
python=$venv/bin/python
"$python" -c 'import ray, submitit' || { say "$venv lacks an extra: pip install -e '.[slurm,ray]'" >&2; exit 2; }

if ! timeout 10 sinfo --noheader >/dev/null 2>&1; then
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null && bash scripts/slurm_here.sh; then
        slurm_is_ours=1
    else
        say "no Slurm can be started here: its jobs are processes of this machine"
    fi
fi

export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" PYTHONWARNINGS=ignore OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
"$python" scripts/check_executors.py --from "$here" "$@"
