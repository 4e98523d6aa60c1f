"""Convex hulls with a margin, calculated by hand, and shapes without geometry."""

from __future__ import annotations

import numpy as np
import pytest
from planning_scenes import corners

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.planning.protocol import Shape
from robocas_ms3.planning.shapes import convex_hull, inflated


def test_an_inflated_box_has_its_faces_moved_out():
    box = corners(0.05, 0.03, 0.02)
    larger, faces = inflated(box, 0.002)
    assert np.abs(larger).max(axis=0) == pytest.approx([0.052, 0.032, 0.022], abs=1e-4)
    assert len(larger) == 8 and len(faces) == 12
    # a flat wedge: its sharp edge moves out by twice the margin at most
    wedge = np.array([[0, 0, 0], [0, 0.1, 0], [0.1, 0, 0.005], [0.1, 0.1, 0.005], [0.1, 0, -0.005], [0.1, 0.1, -0.005]])
    larger, _ = inflated(wedge, 0.002)
    assert larger[:, 0].min() >= -0.004 - 1e-9


def test_normals_of_a_hull_point_outwards():
    vertices, faces, normals = convex_hull(np.concatenate([corners(1, 1, 1), np.zeros((1, 3))]))
    assert len(vertices) == 8  # the one inside is gone
    a, b, c = vertices[faces].transpose(1, 0, 2)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), normals) > 0).all()


def test_a_shape_without_hulls_and_points_is_an_error():
    with pytest.raises(RobocasError) as caught:
        Shape(hulls=())
    assert caught.value.where == "Shape"
