#!/usr/bin/env bash
# All that only a GPU can show, in one command on a CUDA machine: tests marked gpu (contracts with 16 and 256
# envs, scenes as on a CPU, partial resets, restored states, host synchronisation per step, contact buffers, heaps tried
# by its engine; baselines that train and act), then steps a second of 1 to 4096 envs.
#
#   bash scripts/gpu_checks.sh [FOLDER]     # reports go there; default: gpu_checks
#
# Offline too, once SAPIEN's library for GPUs is there: it is downloaded when it is first asked for, into
# ~/.sapien/physx/<version>/libPhysXGpu_64.so; carry that file along.
#
# PYTHON names the interpreter; default: the one scripts/setup.sh made, else python3. It needs what the environments need
# (sapien, mani_skill, torch with CUDA, ...), the train extra and pytest; the motion planner is not used.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=${PYTHON:-.venv/bin/python}
[ -x "$(command -v "$python")" ] || python=python3
out=${1:-gpu_checks}
mkdir -p "$out"
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" OMP_NUM_THREADS=1 PYTHONWARNINGS=ignore

if ! device=$("$python" -c 'import torch; print(torch.cuda.get_device_name())' 2>/dev/null); then
    echo "No CUDA device here. Skipped, and so unproven: contracts with 16 and 256 envs, scenes as on a CPU, partial"
    echo "resets, restored states, host synchronisation per step, contact buffers, heaps tried by its engine, training, steps"
    echo "a second of more than one env."
    "$python" benchmarks/fps.py --envs 1 --modes state --steps 50 | tee "$out/fps.json"
    exit 0
fi

echo "on $device"
if ! "$python" -c 'from sapien import physx; physx.enable_gpu()' 2>"$out/physx.txt"; then
    tail -n 3 "$out/physx.txt"
    echo "PhysX does not start on the GPU. Offline, copy ~/.sapien/physx/ from a machine where it has started once."
    exit 1
fi
failed=0
"$python" -m pytest -m gpu tests/gpu -p no:cacheprovider -v --durations 0 2>&1 | tee "$out/tests.txt" || failed=1
for mode in state rgb; do
    "$python" benchmarks/fps.py --modes "$mode" 2>"$out/fps_$mode.txt" | tee "$out/fps_$mode.json" || failed=1
done
exit $failed
