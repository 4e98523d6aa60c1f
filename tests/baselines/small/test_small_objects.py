"""Pixels of objects in the images, until the gripper command changes."""

from types import SimpleNamespace

import numpy as np
import pytest

from robocas_ms3.baselines.small.objects import locate_objects, to_camera_parent_frame
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_rotation
from robocas_ms3.robots.cameras import standard_camera_parent

STEPS = 5
BASE = [2.0, 1.0, 0.5]  # of the arm in the world, turned by 90 degrees about z
ARRAYS = {
    "base_pos": np.tile(np.float32(BASE), (STEPS, 1)),
    "base_orn": np.tile(np.float32([0, 0, np.sqrt(0.5), np.sqrt(0.5)]), (STEPS, 1)),
    "gripper_status": np.array([True] * STEPS),
}
LAYOUT = {
    "object_ids": ["apple", "pear", "lemon"],
    "poses": [[2, 2, 0.5, 1, 0, 0, 0], [9, 9, 9, 1, 0, 0, 0], [1, 1, 1, 1, 0, 0, 0]],
    "present": [True, False, True],
}
PROJECTIONS = {
    camera: lambda points: points[..., :2].astype(np.float32) for camera in ("base_camera", "gripper_camera")
}


def episode(layout=LAYOUT, target="lemon"):
    scene = {"target": {"asset_id": target}}
    return SimpleNamespace(where="here", layout=layout, scene=scene, camera_parent=standard_camera_parent)


def tcp(heights):
    """Return TCP poses above the apple, fingers down: x axis as in the base, y and z reversed."""
    return from_rotation([[1, 0, height] for height in heights], np.diag([1.0, -1, -1]))


def test_pixels_and_positions_of_objects():
    found = locate_objects(episode(), ARRAYS, tcp([1, 0.9, 0.8, 0.7, 0.6]), PROJECTIONS)
    assert (found.steps, found.target, found.classes) == (STEPS, "lemon", ["apple", "lemon"])
    in_base = [[1, 0], [0, 1]]  # a metre ahead of the arm; a metre to its left, and half a metre up
    assert found.pixels["base_camera"] == pytest.approx(np.tile(np.float32(in_base), (STEPS, 1, 1)), abs=1e-6)
    assert found.points == pytest.approx(np.array([[1, 0, 0], [0, 1, 0.5]]), abs=1e-6)
    in_tcp = [[0, 0], [-1, -1]]
    assert found.pixels["gripper_camera"] == pytest.approx(np.tile(np.float32(in_tcp), (STEPS, 1, 1)), abs=1e-6)


def test_pixels_are_unknown_after_a_gripper_command():
    closed = {**ARRAYS, "gripper_status": np.array([True, True, True, False, True])}
    held = locate_objects(episode(), closed, tcp([1] * STEPS), PROJECTIONS).pixels["gripper_camera"]
    assert np.isnan(held).all((1, 2)).tolist() == [False, False, False, True, True]


def test_world_camera_sees_points_in_the_world_frame():
    points = np.zeros((STEPS, 1, 3))
    assert to_camera_parent_frame("world", points, tcp([1] * STEPS), ARRAYS)[0, 0].tolist() == pytest.approx(BASE)


def test_no_objects_without_layout_or_after_another_policy():
    after = episode()
    after.scene["recorded"] = {"intervention": {"policy": "small", "policy_steps": 5}}
    for unknown in (episode({}), episode({"object_ids": ["apple"], "present": [True]}), after):
        found = locate_objects(unknown, ARRAYS, tcp([1] * STEPS), PROJECTIONS)
        assert (found.classes, found.pixels["base_camera"].shape) == ([], (STEPS, 0, 2))


@pytest.mark.parametrize("layout", [{"poses": [[1, 2]]}, {**LAYOUT, "present": [True]}, {"poses": LAYOUT["poses"]}])
def test_damaged_scene_is_an_error(layout):
    with pytest.raises(DatasetError, match="scene.json: damaged layout of an episode"):
        locate_objects(episode(layout), ARRAYS, tcp([1] * STEPS), PROJECTIONS)
