"""A process that makes layouts for another: what it can't make, and what becomes of it."""

from __future__ import annotations

import os
import pickle
import signal
from unittest.mock import Mock

import numpy as np
import pytest
from sapien import physx

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import LayoutError, SimulationError
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.sample import sample_layout
from robocas_ms3.scenes.source import OtherProcess, Sampler


def model(**changes) -> SceneModel:
    pack = load_pack("builtin")
    data = {**load_task_config("pick_table_scattered").model_dump(mode="json"), **changes}
    return SceneModel.load(load_task_config(data), pack, pack)


def test_it_makes_the_same_layouts_and_ends_with_its_object(monkeypatch):
    monkeypatch.setattr("robocas_ms3.scenes.source._GRACE", 30)  # it leaves by itself, on a busy machine too
    scene = model()
    other = OtherProcess(scene)
    process = other._process
    for seed in (3, 4):
        np.testing.assert_array_equal(other.layout(3, seed).object_poses, sample_layout(scene, 3, seed).object_poses)
    del other
    assert process.poll() == 0


def test_what_it_can_not_make_is_an_error_as_here_and_it_goes_on():
    target, few = {"min_grasps": 10_000}, {"ids": "all", "count": 2}
    data = load_task_config("pick_table_scattered").model_dump(mode="json")
    other = OtherProcess(model(target={**data["target"], **target}, objects=few))
    for _ in range(2):
        with pytest.raises(LayoutError, match="no object qualifies"):
            other.layout(0, 0)


def test_that_it_died_is_no_want_of_a_layout():
    other = OtherProcess(model())
    other.layout(0, 0)
    os.kill(other._process.pid, signal.SIGKILL)
    for _ in range(2):
        with pytest.raises(
            SimulationError, match=r"seed 1: the process that makes layouts died \(found exit code -9\)"
        ):
            other.layout(1, 1)


def test_after_an_interruption_no_answer_is_taken_for_another(monkeypatch):
    monkeypatch.setattr(physx, "is_gpu_enabled", lambda: True)
    scene = model()
    layouts = Sampler(scene)
    layouts(1, 1)
    process = layouts._elsewhere._process
    monkeypatch.setattr(pickle, "load", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        layouts(2, 2)
    monkeypatch.undo()
    assert process.poll() is not None
    monkeypatch.setattr(physx, "is_gpu_enabled", lambda: True)
    np.testing.assert_array_equal(layouts(3, 3).object_poses, sample_layout(scene, 3, 3).object_poses)
