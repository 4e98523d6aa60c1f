"""A process of environments that takes more than it may, without environments."""

import os
import time

import pytest

from robocas_ms3.core.errors import WorkerDied
from robocas_ms3.core.workers import Limits
from robocas_ms3.tasks.vector import handle
from robocas_ms3.tasks.vector.handle import WorkerHandle

HOG = "hog = bytearray(200 * 2**20)\n"


@pytest.mark.parametrize(
    ("program", "limits", "why"),
    [
        ("", Limits(seconds=0.2), "too slow"),
        (HOG, Limits(memory_gb=0.1), "too much memory"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)\n", Limits(60, 1), "SIGSEGV"),
    ],
)
def test_it_is_ended_and_says_why(monkeypatch, program, limits, why):
    sleeping = "import time; time.sleep(1000)  # {path} {connection} {memory} {parent}"
    monkeypatch.setattr(handle, "_PROGRAM", program + sleeping)
    memory = os.memfd_create("none")
    worker = WorkerHandle(range(2, 4), memory)
    worker.limits, begun = limits, time.monotonic()
    with pytest.raises(WorkerDied, match=f"envs 2, 3: its process died .found {why}") as error:
        worker.send(handle.STEP)  # which says so already where the process was the faster
        worker.receive()
    assert error.value.envs == (2, 3)
    assert worker.process.wait(5) < 0
    assert time.monotonic() - begun < 30
    os.close(memory)
