"""Layouts that a worker process samples, where PhysX has a GPU."""

from __future__ import annotations

import _thread
import gc
import os
import signal
import threading

import numpy as np
import psutil
import pytest
from sapien import physx

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import LayoutError, SimulationError
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.sample import sample_layout
from robocas_ms3.scenes.source import Sampler


def load_model(**changes) -> SceneModel:
    pack = load_pack("builtin")
    data = {**load_task_config("pick_table_scattered").model_dump(mode="json"), **changes}
    return SceneModel.load(load_task_config(data), pack, pack)


def children() -> list[psutil.Process]:
    return psutil.Process().children()


@pytest.fixture(autouse=True)
def gpu(monkeypatch):
    monkeypatch.setattr(physx, "is_gpu_enabled", lambda: True)


def test_the_process_samples_the_same_layouts_and_ends_with_its_object():
    model, before = load_model(), children()
    sampler = Sampler(model)
    for seed in (3, 4):
        np.testing.assert_array_equal(sampler(3, seed).object_poses, sample_layout(model, 3, seed).object_poses)
    (process,) = [child for child in children() if child not in before]
    del sampler
    gc.collect()
    assert psutil.wait_procs([process], timeout=30)[0] == [process]


def test_no_layout_is_the_same_error_as_in_this_process():
    data = load_task_config("pick_table_scattered").model_dump(mode="json")
    target = {**data["target"], "min_grasps": 10_000}
    sampler = Sampler(load_model(target=target, objects={"ids": "all", "count": 2}))
    for _ in range(2):
        with pytest.raises(LayoutError):
            sampler(0, 0)


class Deadly:
    """Object ids that kill the process that unpickles them."""

    def __reduce__(self):
        return kill_this_process, ()


def kill_this_process():
    os.kill(os.getpid(), signal.SIGSEGV)


def test_a_process_that_dies_twice_is_no_lack_of_a_layout():
    with pytest.raises(SimulationError) as caught:
        Sampler(load_model()).make(0, 1, Deadly())  # pyright: ignore[reportArgumentType]
    assert (caught.value.where, caught.value.found) == ("seed 1", "SIGSEGV")


def test_a_process_that_dies_is_replaced():
    model, before = load_model(), children()
    sampler = Sampler(model)
    sampler(0, 0)
    (process,) = [child for child in children() if child not in before]
    process.kill()
    process.wait()
    np.testing.assert_array_equal(sampler(1, 1).object_poses, sample_layout(model, 1, 1).object_poses)


def test_after_an_interruption_no_layout_is_taken_for_another():
    model = load_model()
    sampler = Sampler(model)
    sampler(1, 1)
    threading.Timer(0.05, _thread.interrupt_main).start()
    with pytest.raises(KeyboardInterrupt):
        for seed in range(2, 1000):
            sampler(seed, seed)
    np.testing.assert_array_equal(sampler(3, 3).object_poses, sample_layout(model, 3, 3).object_poses)
