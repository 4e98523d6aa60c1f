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
# Where PhysX does not start on the GPU, the batched code runs with CUDA tensors on CPU physics instead
# (tests/support/gpu_emulation). Exit status: 0 all passed, 1 a check failed, 2 all passed but PhysX did not start.
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
    exit $?
fi

echo "on $device"
failed=0
check() { # REPORT ARGUMENTS...: run tests
    local report=$1
    shift
    "$python" -m pytest -p no:cacheprovider -v --durations 0 "$@" 2>&1 | tee "$out/$report" || failed=1
}
measure() { # NAME ARGUMENTS...: steps per second
    local name=$1
    shift
    "$python" benchmarks/fps.py "$@" 2>"$out/$name.txt" | tee "$out/$name.json" || failed=1
}

if "$python" -c 'from sapien import physx; physx.enable_gpu()' >"$out/physx.txt" 2>&1; then
    check tests.txt -m gpu tests/gpu
    for mode in state rgb; do
        measure "fps_$mode" --modes "$mode"
    done
    exit $failed
fi
tail -n 3 "$out/physx.txt"
echo "PhysX does not start on the GPU. Offline, copy ~/.sapien/physx/ from a machine where it has started once."
echo "Instead, the batched code runs with CUDA tensors on CPU physics; one env is timed. Unproven: physics on the GPU,"
echo "its contact buffers, 256 envs, steps per second of more than one env."
export PYTHONPATH="$PYTHONPATH:$PWD/tests/support"
check tests.txt -m gpu tests/gpu/test_baselines.py
check tests_on_cpu_physics.txt -p gpu_emulation.plugin -m "gpu or emulated_gpu_full" tests/gpu
for size in "128 128" "640 480"; do
    measure "fps_rgb_${size/ /x}" --envs 1 --modes rgb --size $size
done
measure fps_state --envs 1 --modes state
[ $failed = 0 ] && exit 2
exit 1
