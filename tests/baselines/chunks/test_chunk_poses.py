"""Chunks of poses, by hand and there and back."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.chunks.poses import Scale, decode, encode, next_keys, spread


def track(seed, length):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (length, 1, 1))
    poses[:, :3, :3] = Rotation.random(length, random_state=seed).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(length, 3))
    return poses, rng.random(length) > 0.5


def test_a_chunk_by_hand():
    poses = np.tile(np.eye(4), (3, 1, 1))
    quarter = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # about z
    poses[0, :3, :3] = quarter
    poses[1, :3, 3] = poses[2, :3, 3] = 0, 0.5, 0.25
    rows = encode(poses, [True, True, False], 3)
    # along y of the base is along x of a TCP that is turned by a quarter; its x axis then points along the base's y
    assert np.allclose(rows[0, 0], [0.5, 0, 0.25, 0, -1, 0, 1, 0, 0, 1])
    assert np.allclose(rows[0, 1, 9], 0)
    assert np.allclose(rows[0, 2], rows[0, 1])  # beyond the end it stays
    assert np.allclose(rows[2], [0, 0, 0, 1, 0, 0, 0, 1, 0, 0])


@given(st.integers(0, 10_000), st.integers(1, 6), st.integers(1, 5))
def test_decoding_gives_the_poses_back(seed, length, steps):
    poses, opened = track(seed, length)
    found, commands = decode(encode(poses, opened, steps), poses[:, None])
    for t in range(length):
        for k in range(steps):
            at = min(t + k + 1, length - 1)
            assert np.allclose(found[t, k], poses[at], atol=1e-5)
            assert commands[t, k] == opened[at]


@given(st.integers(0, 10_000))
def test_what_a_network_says_becomes_a_rotation(seed):
    rows = np.random.default_rng(seed).normal(size=(4, 10))
    poses, _ = decode(rows, np.eye(4))
    assert np.allclose(poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2), np.eye(3), atol=1e-6)
    assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1)


def test_key_poses_are_where_the_gripper_moves_next():
    poses = np.tile(np.eye(4), (7, 1, 1))
    poses[:, 0, 3] = [0, 1, 2, 3, 4, 5, 6]
    # told to close between steps 2 and 3, to open between 4 and 5: it does so where it is at 2 and 4; then the end
    keys = next_keys(poses, [1, 1, 1, 0, 0, 1, 1])
    assert keys[:, 0].tolist() == [2, 1, 0, 1, 0, 1, 0]


def test_scale_and_back():
    motions = np.array([[[0.0] * 9], [[1.0] * 9]])  # two samples of one step: mean 0.5, deviation 0.5
    scale = Scale(**spread(motions))
    import torch

    assert torch.allclose(scale(torch.ones(1, 9)), torch.ones(1, 9))
    assert torch.allclose(scale.back(scale(torch.full((1, 9), 0.3))), torch.full((1, 9), 0.3))
    still = spread(np.zeros((2, 1, 9)))
    assert min(still["deviation"][0]) > 0
