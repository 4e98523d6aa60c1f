"""What is set aside on a GPU, and what is made of the engine's complaints. Neither needs one."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from mani_skill.utils.structs.types import GPUMemoryConfig

from robocas_ms3.errors import SimulationError
from robocas_ms3.tasks.engine_errors import EngineErrors
from robocas_ms3.tasks.gpu_memory import gpu_memory

COMPLAINT = "PhysX Internal CUDA error: Contact buffer overflow detected, please increase its size to at least 3145728"


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
        os.write(2, f"[error] {COMPLAINT}\nand something else\n".encode())
        with pytest.raises(SimulationError, match=r"ran out of memory.*at least 3145728.*gpu_memory_config"):
            heard(errors)
        errors.check()  # once
    assert f"[error] {COMPLAINT}\nand something else\n" in capfd.readouterr().err


def test_a_line_that_comes_in_pieces_is_understood_and_others_are_not_minded(capfd):
    with listening() as errors:
        os.write(2, b"a warning about nothing\n" + COMPLAINT[:40].encode())
        time.sleep(0.05)
        errors.check()
        os.write(2, COMPLAINT[40:].encode() + b"\n")
        with pytest.raises(SimulationError):
            heard(errors)


def test_closing_leaves_a_standard_error_alone_that_is_not_its_own(capfd, tmp_path):
    before = os.dup(2)
    errors = EngineErrors()
    with (tmp_path / "other").open("w") as other:
        os.dup2(other.fileno(), 2)
        errors.close()
        os.write(2, b"mine")
    os.dup2(before, 2)
    os.close(before)
    assert (tmp_path / "other").read_text() == "mine"


def test_standard_error_is_given_back_even_where_nobody_closes():
    program = (
        "import os\nfrom robocas_ms3.tasks.engine_errors import EngineErrors\n"
        "one = EngineErrors()\nos.write(2, b'first\\n')\none.close()\nos.write(2, b'second\\n')\n"
        "two = EngineErrors()\nos.write(2, b'third\\n')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=60, check=False)
    assert done.returncode == 0
    assert [line for line in done.stderr.decode().splitlines() if line in {"first", "second", "third"}] == [
        "first",
        "second",
        "third",
    ]
