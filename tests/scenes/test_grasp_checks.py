"""Directions and clearance of grasps, by hand; see `grasp_poses`."""

from __future__ import annotations

import numpy as np
import pytest
from grasp_poses import CENTER, grasp

from robocas_ms3.scenes.grasp_checks import grasp_direction_tests, is_gripper_clear, select_near_points


@pytest.mark.parametrize(
    ("approach", "lean", "heading", "from_there", "from_the_robots_side"),
    [
        ("top", 0, 0, True, True),  # a vertical approach has no side
        ("top", 10, 180, True, True),  # nearly vertical
        ("top", 20, 180, True, False),  # from behind the object
        ("top", 30, 44, True, True),
        ("top", 30, 46, True, False),
        ("top", 89, 0, True, True),
        ("top", 91, 0, False, True),  # upwards
        ("front", 90, 0, True, True),  # level
        ("front", 31, 0, True, True),  # 59 deg down
        ("front", 29, 0, False, True),  # 61 deg down
        ("front", 99, 0, True, True),  # 9 deg up
        ("front", 101, 0, False, True),
        ("front", 90, 44, True, True),
        ("front", 90, 46, True, False),
        ("front", 90, 180, True, False),  # from behind the object
        ("front", 10, 180, False, False),  # no exception for nearly vertical approaches
    ],
)
def test_approach_directions(approach, lean, heading, from_there, from_the_robots_side):
    found = grasp_direction_tests(grasp(lean, heading)[None], CENTER, approach)
    names = {"top": "from_above", "front": "from_the_front"}[approach], "from_the_robots_side"
    assert [bool(found[name][0]) for name in names] == [from_there, from_the_robots_side]


def test_the_direction_turns_with_the_object():
    sideways = grasp(30, 90)
    assert grasp_direction_tests(sideways[None], np.array([0.0, 0.5, -0.4]))["from_the_robots_side"][0]
    assert not grasp_direction_tests(sideways[None], np.array([0.5, 0.0, -0.4]))["from_the_robots_side"][0]


@pytest.mark.parametrize(
    ("closing", "level"), [(0, True), (59, True), (61, False), (90, False), (119, False), (121, True)]
)
def test_the_closing_axis_may_tilt_by_60_degrees(closing, level):
    # An approach along x: turning about it by c tilts the closing axis (y) by c from the horizontal.
    assert bool(grasp_direction_tests(grasp(90, 0, closing)[None], CENTER)["closing_is_level"][0]) is level


@pytest.mark.parametrize(
    ("point", "clear"),
    [
        ((0.0, 0.0, 0.0), True),  # between the pads
        ((0.0, 0.039, 0.0), True),
        ((0.0, 0.042, 0.0), False),  # in a pad
        ((0.0, -0.042, 0.008), False),  # at the other pad's end, 8 mm beyond the TCP
        ((0.0, 0.042, 0.010), True),  # just below the pad
        ((0.011, 0.042, 0.0), True),  # next to the pad
        ((0.0, 0.055, 0.0), True),  # outside of it
        ((0.0, 0.055, -0.05), False),  # in the knuckle
        ((0.0, 0.0, -0.06), True),  # under the palm
        ((0.0, 0.0, -0.07), False),  # in the palm
        ((0.03, -0.10, -0.1), False),
        ((0.03, -0.11, -0.1), True),
        ((0.0, 0.042, -0.12), False),  # swept by a pad and now in the palm
        ((0.0, 0.0, -0.25), False),  # swept by the palm
        ((0.0, 0.0, -0.29), True),  # above the pre-grasp's palm
    ],
)
def test_points_in_the_open_gripper(point, clear):
    for turn in (0, 180):
        pose = grasp(30, 10, turn)
        inside = pose[:3, :3] @ (np.array(point) * ([1, 1, 1] if turn == 0 else [-1, -1, 1])) + pose[:3, 3]
        assert is_gripper_clear(pose[None], inside[None])[0] == clear


def test_batch_of_grasps_equals_single_checks():
    rng = np.random.default_rng(0)
    grasps = np.stack([grasp(*rng.uniform(-60, 60, 3)) for _ in range(40)])
    grasps[:, :3, 3] += rng.uniform(-0.3, 0.3, (40, 3))
    points = rng.uniform(-0.6, 0.6, (300, 3)) + grasp()[:3, 3]
    expected = []
    for pose in grasps:
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        in_tip = (abs(x) <= 0.01) & (abs(abs(y) - 0.043) <= 0.003) & (z >= -0.14) & (z <= 0.0085)
        in_knuckle = (abs(x) <= 0.012) & (abs(abs(y) - 0.0535) <= 0.0135) & (z >= -0.175) & (z <= -0.02)
        in_palm = (abs(x) <= 0.033) & (abs(y) <= 0.104) & (z >= -0.28) & (z <= -0.067)
        expected.append(not (in_tip | in_knuckle | in_palm).any())
    assert 0 < sum(expected) < 40
    assert is_gripper_clear(grasps, points).tolist() == expected


def test_near_points_decide_which_grasps_are_clear():
    rng = np.random.default_rng(1)
    grasps = np.stack([grasp(*rng.uniform(-60, 60, 3)) for _ in range(20)])
    points = rng.uniform(-1, 1, (5000, 3)) + grasp()[:3, 3]
    near = select_near_points(grasps, points, 0.005)
    assert 0 < len(near) < 1000
    clear = is_gripper_clear(grasps, points, 0.005)
    assert 0 < clear.sum() < 20
    assert np.array_equal(is_gripper_clear(grasps, near, 0.005), clear)
    assert not len(select_near_points(grasps[:0], points))


@pytest.mark.parametrize(
    ("point", "clear"),
    [
        ((0.0, 0.050, 0.0), False),  # 4 mm outside of a pad, which ends at y = 46 mm
        ((0.0, 0.052, 0.0), True),
        ((0.014, 0.042, 0.0), False),  # 4 mm next to it
        ((0.016, 0.042, 0.0), True),
        ((0.0, 0.042, 0.010), True),  # below the pad: the clearance applies to the sides only
    ],
)
def test_free_grasp_has_side_clearance(point, clear):
    pose = grasp(30, 10)
    there = pose[:3, :3] @ np.array(point) + pose[:3, 3]
    assert is_gripper_clear(pose[None], there[None], side_clearance=0.005)[0] == clear
