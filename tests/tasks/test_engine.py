"""Memory limits of PhysX on a GPU, and errors from its messages, tested without a GPU."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import gymnasium as gym
import pytest
import torch
from mani_skill.utils.structs.types import GPUMemoryConfig

from robocas_ms3.core.errors import SimulationError, VectorEnvError
from robocas_ms3.tasks.engine import EngineErrorMonitor, check_engine_arguments, gpu_memory_limits

COMPLAINT = "[2026-01-01 00:00:00.000] [SAPIEN] [error] Contact buffer overflow detected, please increase its size to 9"
OTHERS = (
    "[SAPIEN] [critical] the application need to increase the PxgDynamicsMemoryConfig::foundLostPairsCapacity "
    "parameter to 3000, otherwise the simulation will miss interactions",
    "[SAPIEN] [error] PhysX Internal CUDA error. Simulation can not continue!",
    "[SAPIEN] [error] PxgPinnedHostLinearMemoryAllocator: overflowing initial allocation size, increase capacity to at "
    "least 9",
)
HARMLESS = (
    "RuntimeWarning: overflow encountered in exp",
    "[SAPIEN] [warning] the buffer is about to overflow",
    "you may want to increase its size",
)


@pytest.mark.parametrize(("num_envs", "sim_backend"), [(2, "auto"), (1, "physx_cuda"), (1, "gpu")])
def test_failed_download_of_the_gpu_library_is_an_error(monkeypatch, num_envs, sim_backend):
    def fail_to_enable() -> None:
        raise ConnectionError("Failed to resolve 'github.com'")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("sapien.physx.enable_gpu", fail_to_enable)
    check_engine_arguments(1, "full")
    with pytest.raises(VectorEnvError, match="ConnectionError.*github.*copy ~/.sapien/physx"):
        check_engine_arguments(num_envs, "full", sim_backend)


def test_few_envs_have_the_memory_limits_of_maniskill():
    assert gpu_memory_limits(1, 15) == gpu_memory_limits(16, 10) == GPUMemoryConfig()


def test_capacities_grow_with_envs_and_objects_by_hand():
    found = gpu_memory_limits(1024, 15)
    assert found.max_rigid_contact_count == 2**20  # 1024 * (50 * 15 + 100) = 870 400
    assert found.max_rigid_patch_count == 2**19  # 1024 * (16 * 15 + 32) = 278 528
    assert found.collision_stack_size == 2**28  # 142.6 M
    assert found.temp_buffer_capacity == 2**26  # 55.7 M
    assert gpu_memory_limits(4096, 15).max_rigid_contact_count == 2**22
    assert gpu_memory_limits(4096, 4).max_rigid_contact_count == 2**21


@contextmanager
def monitor_standard_error() -> Iterator[EngineErrorMonitor]:
    """Monitor standard error.

    This is no fixture, because pytest replaces standard error between fixtures and tests.
    """
    errors = EngineErrorMonitor()
    errors.open()
    try:
        yield errors
    finally:
        errors.close()


def check_for_one_second(errors: EngineErrorMonitor) -> None:
    """Check for an error 100 times within one second."""
    for _ in range(100):
        errors.check()
        time.sleep(0.01)


def test_overflow_is_an_error_with_a_fix_and_is_still_printed(capfd):
    with monitor_standard_error() as errors:
        os.write(2, f"{COMPLAINT}\n{COMPLAINT}\nand something else\n".encode())
        with pytest.raises(SimulationError, match=r"ran out of memory.*its size to 9.*gpu_memory_config"):
            check_for_one_second(errors)
        errors.check()  # once
    assert f"{COMPLAINT}\n{COMPLAINT}\nand something else\n" in capfd.readouterr().err


@pytest.mark.parametrize("line", OTHERS)
def test_other_messages_of_physx_are_recognised(line, capfd):
    with monitor_standard_error() as errors:
        os.write(2, f"{line}\n".encode())
        with pytest.raises(SimulationError):
            check_for_one_second(errors)


def test_unrelated_output_is_ignored(capfd):
    with monitor_standard_error() as errors:
        os.write(2, "\n".join(HARMLESS).encode() + b"\n")
        time.sleep(0.2)
        errors.check()


def test_two_envs_of_a_process_get_the_error(capfd):
    with monitor_standard_error() as one, monitor_standard_error() as other:
        os.write(2, f"{COMPLAINT}\n".encode())
        for errors in (one, other):
            with pytest.raises(SimulationError):
                check_for_one_second(errors)


def test_output_of_a_crashing_process_is_kept():
    program = (
        "import faulthandler, os\nfrom robocas_ms3.tasks.engine import EngineErrorMonitor\nfaulthandler.enable()\n"
        "errors = EngineErrorMonitor()\nerrors.open()\nos.write(2, b'x' * 300_000 + b'\\n')\nos.abort()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=60, check=False)
    assert done.returncode == -signal.SIGABRT
    assert b"x" * 300_000 in done.stderr
    assert b"Fatal Python error: Aborted" in done.stderr


@pytest.mark.slow
def test_render_system_is_kept_between_environments(needs_renderer):
    seen = []
    for seed in (1, 0, 1):
        env = gym.make(
            "RoboCASPick-v1", obs_mode="rgb", sim_backend="physx_cpu", sensor_configs={"width": 32, "height": 24}
        )
        seen.append(env.reset(seed=seed)[0]["sensor_data"]["base_camera"]["rgb"])
        env.close()
    assert torch.equal(seen[0], seen[2])
    assert not torch.equal(seen[0], seen[1])
