#!/usr/bin/env bash
# Run all checks that need a GPU, on a machine with CUDA: the tests marked gpu, then steps per second with 1 to 4096 envs.
# The tests cover contracts with 16 and 256 envs, scenes equal to those on a CPU, partial resets, restored states, host
# synchronisation per step, contact buffers, heaps checked by the GPU's physics, and training and inference of baselines.
#
#   bash scripts/gpu_checks.sh [FOLDER]     # writes reports to FOLDER (default: gpu_checks)
#
# SAPIEN downloads its GPU library at the first use to ~/.sapien/physx/<version>/libPhysXGpu_64.so. On a machine without
# internet, copy that file from another machine.
#
# If PhysX does not start on the GPU, the batched code runs with CUDA tensors on CPU physics (tests/support/gpu_emulation).
# Exit status: 0 all passed, 1 a check failed, 2 all passed but PhysX did not start.
#
# PYTHON names the interpreter (default: that of scripts/setup.sh, else python3). It needs the packages of the environments
# (sapien, mani_skill, torch with CUDA, ...), the extra `train` and pytest, but not the motion planner.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=${PYTHON:-.venv/bin/python}
[ -x "$(command -v "$python")" ] || python=python3
out=${1:-gpu_checks}
mkdir -p "$out"
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" OMP_NUM_THREADS=1 PYTHONWARNINGS=ignore

if ! device=$("$python" -c 'import torch; print(torch.cuda.get_device_name())' 2>/dev/null); then
    echo "No CUDA device. Not tested: contracts with 16 and 256 envs, scenes equal to those on a CPU, partial resets,"
    echo "restored states, host synchronisation per step, contact buffers, heaps checked by the GPU's physics, training,"
    echo "steps per second of more than one env."
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
echo "PhysX does not start on the GPU. Without internet, copy ~/.sapien/physx/ from a machine on which it has started."
echo "The batched code is tested with CUDA tensors on CPU physics, and one env is timed. Not tested: physics on the GPU,"
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
