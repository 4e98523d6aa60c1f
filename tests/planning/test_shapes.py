"""Convex hulls with a margin, worked out by hand, and poses as FCL takes them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from planning_scenes import corners
from scipy.spatial.transform import Rotation

from robocas_ms3.planning.shapes import convex_hull, inflated, matrix_to_pose
from robocas_ms3.poses import from_wxyz as as_matrix


def test_a_pose_of_a_matrix_turns_as_it_does():
    turns = [Rotation.random(random_state=i) for i in range(20)]
    turns += [Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3)] + [Rotation.identity()]
    for turn in turns:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), (1, 2, 3)
        np.testing.assert_allclose(as_matrix(torch.as_tensor(matrix_to_pose(matrix))), matrix, atol=1e-12)


def test_an_inflated_box_has_its_faces_moved_out():
    box = corners(0.05, 0.03, 0.02)
    larger, faces = inflated(box, 0.002)
    assert np.abs(larger).max(axis=0) == pytest.approx([0.052, 0.032, 0.022], abs=1e-4)
    assert len(larger) == 8 and len(faces) == 12
    # a flat wedge: its sharp edge moves out by twice the margin at most
    wedge = np.array([[0, 0, 0], [0, 0.1, 0], [0.1, 0, 0.005], [0.1, 0.1, 0.005], [0.1, 0, -0.005], [0.1, 0.1, -0.005]])
    larger, _ = inflated(wedge, 0.002)
    assert larger[:, 0].min() >= -0.004 - 1e-9


def test_faces_of_a_hull_are_seen_from_outside():
    vertices, faces, normals = convex_hull(np.concatenate([corners(1, 1, 1), np.zeros((1, 3))]))
    assert len(vertices) == 8  # the one inside is gone
    a, b, c = vertices[faces].transpose(1, 0, 2)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), normals) > 0).all()
