"""Rigid transforms: known values, round trips, single poses against batches."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocas_ms3.core import poses


@st.composite
def transforms(draw):
    """(N, 2, 4, 4)"""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(1, 9))
    turns = Rotation.random(2 * count, random_state=rng).as_matrix().reshape(count, 2, 3, 3)
    return poses.from_rotation(rng.uniform(-2, 2, (count, 2, 3)), turns)


def test_transforms_of_known_poses():
    # a quarter turn about z, at (1, 2, 3): the frame's x points along the world's y
    pose = poses.from_wxyz(np.array([1, 2, 3, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]))
    np.testing.assert_allclose(pose, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(poses.from_xyz_yaw(1, 2, 3, np.pi / 2), pose, atol=1e-12)
    np.testing.assert_allclose(poses.transform_points(pose, np.array([[1.0, 0, 0]])), [[1, 3, 3]], atol=1e-12)
    np.testing.assert_allclose(poses.inverse(pose)[:3, 3], [-2, 1, -3], atol=1e-12)
    np.testing.assert_array_equal(poses.from_wxyz(torch.tensor([1.0, 2, 3, 1, 0, 0, 0]))[:3, 3], [1, 2, 3])


@settings(max_examples=50, deadline=None)
@given(transforms())
def test_inverse_and_conversions_round_trip(some):
    np.testing.assert_allclose(poses.inverse(some) @ some, np.broadcast_to(np.eye(4), some.shape), atol=1e-12)
    np.testing.assert_allclose(poses.from_wxyz(poses.to_wxyz(some)), some, atol=1e-12)
    seven = poses.to_wxyz(some)
    again = poses.from_xyzw(seven[..., :3], poses.wxyz_to_xyzw(seven[..., 3:]))
    np.testing.assert_array_equal(again, poses.from_wxyz(seven))


@settings(max_examples=50, deadline=None)
@given(transforms())
def test_a_single_pose_equals_a_batch_element_bitwise(some):
    seven = poses.to_wxyz(some)
    for index in np.ndindex(*some.shape[:-2]):
        np.testing.assert_array_equal(poses.from_wxyz(seven[index]), poses.from_wxyz(seven)[index])
        np.testing.assert_array_equal(poses.inverse(some[index]), poses.inverse(some)[index])
