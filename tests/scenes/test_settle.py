"""Stable objects, and objects that fall or move."""

import numpy as np
import pytest
from scene_models import load_scene

from robocas_ms3.core.poses import from_xyz_yaw
from robocas_ms3.scenes.settle import settle


@pytest.fixture(scope="module")
def model():
    return load_scene()


def on_table(model, name: str, x: float = 0.9, y: float = 0.9, lift: float = 0.0) -> np.ndarray:
    notes = model.object_pack.objects[name].annotations
    stands = notes.resting_poses[max(notes.display_pose, 0)]
    return from_xyz_yaw(x, y, 0.61 + lift, 0.3) @ stands


def run(model, names, poses):
    return settle([model.object_pack.objects[n] for n in names], np.stack(poses), model, model.basket_pose)


def test_objects_in_resting_poses_are_stable(model):
    poses = [on_table(model, "sugar_box"), on_table(model, "mug", 1.0, 1.1)]
    settled, stable = run(model, ["sugar_box", "mug"], poses)
    assert stable
    assert np.abs(settled - poses).max() < 0.003


def test_object_that_falls_settles_deterministically(model):
    runs = [run(model, ["sugar_box"], [on_table(model, "sugar_box", lift=0.02)]) for _ in range(2)]
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    settled, stable = runs[0]
    assert stable
    assert settled[0, 2, 3] == pytest.approx(on_table(model, "sugar_box")[2, 3], abs=0.002)


@pytest.mark.parametrize(
    ("y", "lift", "lean"),
    [(2.5, 0.0, 0.0), (0.9, 0.08, 0.0), (0.9, 0.0, 0.5)],
    ids=["next to the table", "comes to rest elsewhere", "tips over"],
)
def test_unstable_objects_are_detected(model, y, lift, lean):
    pose = on_table(model, "drink", y=y, lift=lift)
    turn = np.array([[np.cos(lean), 0, np.sin(lean)], [0, 1, 0], [-np.sin(lean), 0, np.cos(lean)]])
    pose[:3, :3] = turn @ pose[:3, :3]
    assert not run(model, ["drink"], [pose])[1]
