from dataclasses import replace

import numpy as np

from robocas_ms3.datasets.checks.depth import DepthView, check_depth_views, compare_depth


def overhead(height, *, depth=None, size=80, shift=0.0):
    """A camera at (shift, 0, height) that views the floor vertically, x as in the world frame."""
    pose = np.diag([1.0, -1, -1, 1])
    pose[:3, 3] = shift, 0, height
    depth = height if depth is None else depth
    image = np.full((size, size), round(depth * 1000), np.uint16)
    return DepthView("overhead", image, np.full(4, size / 2), pose)


def test_points_by_hand():
    # 90 deg: pixel (20, 20)'s corner is the centre; a pixel is 2 m / 40 = 5 cm wide at 1 m.
    points = overhead(1.0, size=40).points()
    assert points.shape == (1600, 3)
    np.testing.assert_allclose(points[0], [-0.975, 0.975, 0], atol=1e-9)
    np.testing.assert_allclose(points[:, 2], 0, atol=1e-9)


def test_empty_depth_has_no_points():
    view = overhead(1.0, size=40)
    view.depth[10:20] = 0
    assert len(view.points()) == 1200


def seen(points, view):
    return compare_depth(points, view, np.full(len(points), np.inf))


def test_compare_by_hand():
    floor = overhead(2.0).points()
    assert seen(floor, overhead(1.0))[1:] == (0.0, 1.0)
    # 10 cm too deep: it sees through the floor. 10 cm too near: something may hide the floor.
    assert seen(floor, overhead(1.0, depth=1.1))[1:] == (1.0, 0.0)
    assert seen(floor, overhead(1.0, depth=0.9))[1:] == (0.0, 0.0)
    assert seen(floor + [50, 0, 0], overhead(1.0)) == (0, 0.0, 0.0)


def test_floor():
    below = ["no points below the floor", "the floor at height 0"]
    assert [found[2] for found in check_depth_views([[overhead(1.0, depth=1.1)]])] == below
    assert [found[2] for found in check_depth_views([[overhead(1.0, depth=0.9)]])][0] == "the floor at height 0"


def test_gripper_camera_may_see_the_bottom_of_a_drawer():
    seen = overhead(1.0, depth=0.945)  # 5.5 cm above the floor, level
    assert list(check_depth_views([[replace(seen, on_gripper=True)]])) == []
    assert [found[2] for found in check_depth_views([[seen]])] == ["the floor at height 0"]


def test_lower_edge_of_a_wall_is_not_the_floor():
    """From a height of 0.55 m, the visible part of a wall 1 m ahead starts 5 cm above the floor."""
    pose = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0.55], [0, 0, 0, 1.0]])
    wall = DepthView("ahead", np.full((80, 80), 1000, np.uint16), np.array([80.0, 80, 40, 40]), pose)
    heights = wall.points()[:, 2]
    assert heights.min() > 0.05 and np.sum(heights < 0.15) > 600
    assert list(check_depth_views([[wall]])) == []
    # Stripes of another wall 30 cm behind it, from 0.35 m up and nearer: from one to the other is no level surface.
    pose[2, 3], striped = 0.35, np.full((80, 80), 1000, np.uint16)
    striped[::2] = 1300
    wall = DepthView("ahead", striped, np.array([160.0, 160, 40, 40]), pose)
    assert np.sum(wall.points()[:, 2] < 0.15) > 600
    assert list(check_depth_views([[wall]])) == []


def test_cameras_without_common_points_need_not_agree():
    alone = overhead(1.0)
    assert list(check_depth_views([[alone]])) == []
    blind = DepthView("blind", np.zeros((80, 80), np.uint16), alone.intrinsic, alone.camera_in_world)
    assert [found[1] for found in check_depth_views([[alone, blind]])] == ["blind"]
    tiny = DepthView("tiny", alone.depth[:9, :9], np.full(4, 4.5), alone.camera_in_world)  # 81 points
    assert list(check_depth_views([[tiny, DepthView("too", tiny.depth, tiny.intrinsic, tiny.camera_in_world)]])) == []


def test_camera_without_overlap_is_reported():
    away = overhead(1.0, shift=50.0)
    away = DepthView("away", away.depth, away.intrinsic, away.camera_in_world)
    assert {found[1:3] for found in check_depth_views([[overhead(1.0), away]])} == {
        ("overhead", "depth that agrees with another camera"),
        ("away", "depth that agrees with another camera"),
    }


def test_wrong_view_among_correct_ones_is_reported():
    low, high, moved = overhead(1.0), overhead(2.0, shift=0.2), overhead(1.5, depth=1.56)
    named = [
        DepthView(name, v.depth, v.intrinsic, v.camera_in_world)
        for name, v in zip("abc", (low, high, moved), strict=True)
    ]
    assert list(check_depth_views([named[:2]])) == []
    # The third one's floor is 6 cm below the others'.
    broken = {(index, camera, expected) for index, camera, expected, _ in check_depth_views([named[:2], named])}
    assert (1, "c", "the floor at height 0") in broken
    assert (1, "c", "no view through surfaces that a sees") in broken
    assert (0, "c", "depth that agrees with another camera") in broken
