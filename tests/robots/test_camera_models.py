"""Camera models: parent frames of mounts, by hand."""

import numpy as np
import pytest

from robocas_ms3.core.poses import inverse
from robocas_ms3.robots.camera_models import find_mount_in_parent, find_parent_in_base, to_intrinsic_matrix
from robocas_ms3.robots.registry import find_robot


def test_mounts_are_constant_in_their_parent_frames():
    """The TCP is 0.1334 m before the hand, with its axes; the arm's base is 0.23 m above the base link."""
    robot = find_robot("robocas_mobile_panda")
    hand, base = (find_mount_in_parent(robot, mount) for mount in ("hand", "base"))
    np.testing.assert_allclose(hand, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -0.1334], [0, 0, 0, 1]], atol=1e-9)
    np.testing.assert_allclose(base, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -0.23], [0, 0, 0, 1]], atol=1e-9)
    np.testing.assert_array_equal(find_mount_in_parent(robot, "world"), np.eye(4))


@pytest.mark.parametrize("parent", ["ee", "arm_base", "world"])
def test_parents_in_the_frame_of_the_arm_base(parent):
    rng = np.random.default_rng(0)
    tcp, base = np.tile(np.eye(4), (2, 5, 1, 1))
    tcp[:, :3, 3], base[:, :3, 3] = rng.normal(size=(2, 5, 3))
    expected = {"ee": tcp, "arm_base": np.tile(np.eye(4), (5, 1, 1)), "world": inverse(base)}[parent]
    np.testing.assert_array_equal(find_parent_in_base(parent, tcp, base), expected)


def test_intrinsic_matrix():
    assert to_intrinsic_matrix(np.array([2.0, 3.0, 4.0, 5.0])).tolist() == [[2, 0, 4], [0, 3, 5], [0, 0, 1]]
