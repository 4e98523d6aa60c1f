"""What is set aside on a GPU, and what is made of the engine's complaints. Neither needs one."""

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
from robocas_ms3.tasks.engine import EngineErrors, check_engine, gpu_memory

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
def test_a_library_for_gpus_that_cannot_be_downloaded(monkeypatch, num_envs, sim_backend):
    def enable() -> None:
        raise ConnectionError("Failed to resolve 'github.com'")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("sapien.physx.enable_gpu", enable)
    check_engine(1, "full")
    with pytest.raises(VectorEnvError, match="ConnectionError.*github.*copy ~/.sapien/physx"):
        check_engine(num_envs, "full", sim_backend)


def test_few_envs_take_no_more_than_maniskills():
    assert gpu_memory(1, 15) == gpu_memory(16, 10) == GPUMemoryConfig()


def test_capacities_grow_with_envs_and_objects_by_hand():
    found = gpu_memory(1024, 15)
    assert found.max_rigid_contact_count == 2**20  # 1024 * (50 * 15 + 100) = 870 400
    assert found.max_rigid_patch_count == 2**19  # 1024 * (16 * 15 + 32) = 278 528
    assert found.collision_stack_size == 2**28  # 142.6 M
    assert found.temp_buffer_capacity == 2**26  # 55.7 M
    assert gpu_memory(4096, 15).max_rigid_contact_count == 2**22
    assert gpu_memory(4096, 4).max_rigid_contact_count == 2**21


@contextmanager
def listening() -> Iterator[EngineErrors]:
    """Not a fixture: between fixtures and tests pytest replaces standard error itself."""
    errors = EngineErrors()
    errors.open()
    try:
        yield errors
    finally:
        errors.close()


def heard(errors: EngineErrors) -> None:
    """Check until something is heard, for a second at most."""
    for _ in range(100):
        errors.check()
        time.sleep(0.01)


def test_an_overflow_is_an_error_that_says_what_to_do_and_is_passed_on(capfd):
    with listening() as errors:
        os.write(2, f"{COMPLAINT}\n{COMPLAINT}\nand something else\n".encode())
        with pytest.raises(SimulationError, match=r"ran out of memory.*its size to 9.*gpu_memory_config"):
            heard(errors)
        errors.check()  # once
    assert f"{COMPLAINT}\n{COMPLAINT}\nand something else\n" in capfd.readouterr().err


@pytest.mark.parametrize("line", OTHERS)
def test_other_complaints_are_understood(line, capfd):
    with listening() as errors:
        os.write(2, f"{line}\n".encode())
        with pytest.raises(SimulationError):
            heard(errors)


def test_what_others_write_is_not_minded(capfd):
    with listening() as errors:
        os.write(2, "\n".join(HARMLESS).encode() + b"\n")
        time.sleep(0.2)
        errors.check()


def test_two_envs_of_a_process_hear_it(capfd):
    with listening() as one, listening() as other:
        os.write(2, f"{COMPLAINT}\n".encode())
        for errors in (one, other):
            with pytest.raises(SimulationError):
                heard(errors)


def test_what_a_crashing_process_says_is_not_lost():
    program = (
        "import faulthandler, os\nfrom robocas_ms3.tasks.engine import EngineErrors\nfaulthandler.enable()\n"
        "errors = EngineErrors()\nerrors.open()\nos.write(2, b'x' * 300_000 + b'\\n')\nos.abort()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=60, check=False)
    assert done.returncode == -signal.SIGABRT
    assert b"x" * 300_000 in done.stderr
    assert b"Fatal Python error: Aborted" in done.stderr


@pytest.mark.slow
def test_one_stays_from_one_environment_to_the_next_which_sees_the_same(needs_renderer):
    seen = []
    for seed in (1, 0, 1):
        env = gym.make(
            "RoboCASPick-v1", obs_mode="rgb", sim_backend="physx_cpu", sensor_configs={"width": 32, "height": 24}
        )
        seen.append(env.reset(seed=seed)[0]["sensor_data"]["base_camera"]["rgb"])
        env.close()
    assert torch.equal(seen[0], seen[2])
    assert not torch.equal(seen[0], seen[1])
