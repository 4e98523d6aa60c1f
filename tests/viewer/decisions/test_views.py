"""Lines of candidates, and their projection to pixels; expected values are worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robocas_ms3.viewer.decisions.strokes import Stroke, make_strokes
from robocas_ms3.viewer.decisions.views import CameraView, TopView, find_region, make_top_view, project_stroke

DOWN = (0.0, 1.0, 0.0, 0.0)  # half a turn about x: the TCP points down
UNKNOWN = np.full(7, np.nan)
# a camera 1 m above the origin of the base that looks down; image right is -y, image down is -x
ABOVE = np.array([[0, -1, 0, 0], [-1, 0, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1.0]])
CAMERA = CameraView("base_camera", (640, 480), np.array([400.0, 400, 320, 240]), ABOVE)


def pose(x, y, z):
    return np.array([x, y, z, *DOWN])


def test_grasp_is_a_fork_along_the_closing_direction():
    fingers, hand = make_strokes("grasp", pose(0.5, 0.1, 0.2), UNKNOWN)
    # the TCP's y is -y of the base and its z is down: finger ends 1 cm below the TCP, palm 3.5 cm above
    expected = [[0.5, 0.14, 0.19], [0.5, 0.14, 0.235], [0.5, 0.06, 0.235], [0.5, 0.06, 0.19]]
    np.testing.assert_allclose(fingers.points, expected, atol=1e-9)
    np.testing.assert_allclose(hand.points, [[0.5, 0.1, 0.235], [0.5, 0.1, 0.275]], atol=1e-9)


@pytest.mark.parametrize(
    ("primitive", "arrows", "dashed", "lines"),
    [("push", 1, 0, 1), ("pull", 1, 0, 1), ("lift", 1, 1, 3), ("grasp", 0, 0, 2), ("release", 0, 0, 1)],
)
def test_lines_by_primitive(primitive, arrows, dashed, lines):
    found = make_strokes(primitive, pose(0.5, 0, 0.2), pose(0.6, 0, 0.2))
    assert [len(found), sum(s.arrow for s in found), sum(s.dashed for s in found)] == [lines, arrows, dashed]


def test_unknown_poses_give_no_lines():
    assert make_strokes("push", pose(0, 0, 0), UNKNOWN) == []
    assert make_strokes("grasp", UNKNOWN, UNKNOWN) == []
    assert len(make_strokes("lift", pose(0, 0, 0), UNKNOWN)) == 2  # the fork


def test_camera_projects_by_its_intrinsics():
    pixels, scale = CAMERA.project(np.array([[0.1, 0.2, 0.5], [0, 0, 0], [0, 0, 1.5]]))
    # 0.5 m in front of the camera: 800 pixels per metre; the third point is behind it
    np.testing.assert_allclose(pixels, [[320 - 160, 240 - 80], [320, 240], [np.nan, np.nan]])
    np.testing.assert_allclose(scale, [800, 400, np.nan])


def test_top_view_has_x_up_and_y_left():
    view = TopView((0.5, 0.0), 1000.0)
    pixels, _ = view.project(np.array([[0.5, 0.0, 3.0], [0.6, 0.1, 0.0]]))
    np.testing.assert_allclose(pixels, [[320, 240], [220, 140]])


@given(st.lists(st.tuples(*[st.floats(-2, 2)] * 3), min_size=1, max_size=6))
def test_top_view_shows_all_points(points):
    points = np.array(points)
    view = make_top_view(points)
    pixels, _ = view.project(points)
    assert ((pixels > 0) & (pixels < view.size)).all()


def test_arrow_has_a_symmetric_head_at_its_end():
    shaft, head = project_stroke(CAMERA, Stroke(np.array([[0, 0, 0], [0, -0.5, 0.0]]), arrow=True))
    np.testing.assert_allclose(shaft, [[320, 240], [520, 240]])
    np.testing.assert_allclose(head[1], [520, 240])
    length = 0.018 * 400
    np.testing.assert_allclose(np.linalg.norm(head[[0, 2]] - head[1], axis=1), length)
    np.testing.assert_allclose(head[[0, 2]].mean(axis=0), [520 - length * np.cos(np.radians(28)), 240])


def test_lines_behind_the_camera_are_not_drawn():
    assert project_stroke(CAMERA, Stroke(np.array([[0, 0, 0], [0, 0, 2.0]]))) == []


def test_region_contains_the_points_with_a_margin():
    left, top, width, height = find_region(CAMERA, [np.array([[100.0, 100], [300, 100]]), np.array([[-50.0, 20]])])
    assert (left, width, height) == (70, 260, 195)  # 200 pixels and 15 % on each side, 4:3
    assert top == 100 - 195 / 2
    assert find_region(CAMERA, [np.array([[-5.0, 20], [np.nan, np.nan]])]) == (0, 0, 640, 480)


@given(st.lists(st.tuples(st.floats(0, 640), st.floats(0, 480)), min_size=1, max_size=6))
def test_region_is_inside_the_image(points):
    left, top, width, height = find_region(CAMERA, [np.array(points)])
    assert left >= 0 <= top
    assert left + width <= 640 + 1e-6
    assert top + height <= 480 + 1e-6
    assert width / height == pytest.approx(4 / 3)
