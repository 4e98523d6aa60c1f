"""Measures of a scene, compared with those of the environment and of the skills."""

import numpy as np
import pytest
import torch

from robocas_ms3.demos.candidates.measure import measure_scene
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.planning.decisions import IrreversibleDecisions
from robocas_ms3.planning.executor import MotionExecutor
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.remove import count_clear_grasps


@pytest.fixture(scope="module")
def generator():
    generator = EpisodeGenerator(EpisodeSettings("search", "search_table_small_heap", check_rate=0))
    yield generator
    generator.close()


@pytest.fixture
def arm(generator):
    executor = MotionExecutor(generator.env, 3)
    executor.reset()
    decisions = IrreversibleDecisions(lambda: len(executor.actions))
    return Arm(generator.planner, generator.inverse_kinematics, executor, decisions)


def test_clutter_of_the_target_is_that_of_the_environment(arm):
    found, clutter = measure_scene(arm), arm.env.measure_clutter()
    assert found.hidden_fraction[arm.target] == pytest.approx(float(clutter.hidden_fraction[0]))
    assert found.obstacles[arm.target] == int(clutter.obstacles.sum())


def test_every_object_has_its_own_measures(arm):
    found = measure_scene(arm)
    present = np.flatnonzero(arm.env.present[0].numpy())
    assert found.free_grasps[present].tolist() == [count_clear_grasps(arm, slot) for slot in present.tolist()]
    assert len(set(found.hidden_fraction[present].tolist())) > 1
    assert not found.held.any()
    assert not found.fallen.any()
    assert not found.in_basket.any()
    assert np.isnan(found.opening)


def test_measures_that_reuse_earlier_ones_are_equal(arm):
    before = measure_scene(arm)
    slot = next(slot for slot in range(len(arm.env.objects)) if slot != arm.target)
    pose = arm.env.objects[slot].pose.raw_pose.clone()
    pose[0, :3] += torch.tensor([0.0, 0.0, 0.3])
    arm.env.objects[slot].set_pose(type(arm.env.objects[slot].pose).create(pose))
    arm.env.evaluate()
    reused, new = measure_scene(arm, before), measure_scene(arm)
    np.testing.assert_array_equal(reused.free_grasps, new.free_grasps)
    assert (new.free_grasps != before.free_grasps).any()
    assert np.nanmax(np.abs(new.object_in_base - before.object_in_base)) == pytest.approx(0.3, abs=1e-3)
