#!/usr/bin/env bash
# Run all checks that need a CUDA device: the tests marked gpu, then a benchmark of steps per second with 1 to 4096 envs.
# The tests cover: shapes and devices with 16 and 256 envs, scenes compared with a CPU, partial resets, restored states,
# host synchronisation per step, contact buffers, the stability of heaps, and training and inference of baselines.
#
#   bash scripts/gpu_checks.sh [FOLDER]     # writes reports to FOLDER (default: gpu_checks)
#
# At the first use, SAPIEN downloads the GPU library of PhysX to ~/.sapien/physx/<version>/libPhysXGpu_64.so. On a machine
# without internet, copy this file from another machine.
#
# If PhysX does not start on the GPU, the tests use CUDA tensors with physics on the CPU (tests/support/gpu_emulation).
# Exit status: 0: all checks passed; 1: a check failed; 2: all checks passed, but PhysX did not start on the GPU.
#
# PYTHON  Python interpreter (default: .venv/bin/python, which scripts/setup.sh creates, or else python3). It needs sapien,
#         mani_skill, torch with CUDA, the extra `train` and pytest, but not the motion planner.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=${PYTHON:-.venv/bin/python}
[ -x "$(command -v "$python")" ] || python=python3
out=${1:-gpu_checks}
mkdir -p "$out"
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" OMP_NUM_THREADS=1 PYTHONWARNINGS=ignore

if ! device=$("$python" -c 'import torch; print(torch.cuda.get_device_name())' 2>/dev/null); then
    echo "gpu_checks: no CUDA device. Not tested: several envs on one GPU (shapes, scenes, partial resets, restored states,"
    echo "host synchronisation, contact buffers, stability of heaps), training on a GPU, steps per second of several envs."
    echo "Steps per second of one env on the CPU:"
    "$python" benchmarks/fps.py --envs 1 --modes state --steps 50 | tee "$out/fps.json"
    exit $?
fi

echo "gpu_checks: device $device"
failed=0
check() { # check REPORT PYTEST_ARGUMENTS...: run tests and write their output to REPORT
    local report=$1
    shift
    "$python" -m pytest -p no:cacheprovider -v --durations 0 "$@" 2>&1 | tee "$out/$report" || failed=1
}
measure() { # measure NAME ARGUMENTS...: measure steps per second with benchmarks/fps.py and write NAME.json
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
echo "gpu_checks: PhysX does not start on the GPU. Without internet, copy ~/.sapien/physx/ from a machine on which it starts."
echo "The tests use CUDA tensors with physics on the CPU, and the steps per second of one env are measured. Not tested:"
echo "physics and contact buffers on the GPU, 256 envs, steps per second of several envs."
export PYTHONPATH="$PYTHONPATH:$PWD/tests/support"
check tests.txt -m gpu tests/gpu/test_baselines.py tests/gpu/test_generate_on_gpu.py
check tests_on_cpu_physics.txt -p gpu_emulation.plugin -m "gpu or emulated_gpu_full" tests/gpu
for size in "128 128" "640 480"; do
    measure "fps_rgb_${size/ /x}" --envs 1 --modes rgb --size $size
done
measure fps_state --envs 1 --modes state
[ $failed = 0 ] && exit 2
exit 1
