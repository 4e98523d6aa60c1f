"""Inflated hulls compared with known ones, and octrees with a decoder of octomap's format."""

from __future__ import annotations

import numpy as np
import pytest
from planning_scenes import corners

from robocas_ms3.planning.shapes import DEPTH, convex_hull, encode_octree, inflate_hull


def test_faces_of_an_inflated_box_are_moved_out():
    box = corners(0.05, 0.03, 0.02)
    larger, faces = inflate_hull(box, 0.002)
    assert np.abs(larger).max(axis=0) == pytest.approx([0.052, 0.032, 0.022], abs=1e-4)
    assert len(larger) == 8 and len(faces) == 12
    # a flat wedge: its sharp edge moves out by twice the margin at most
    wedge = np.array([[0, 0, 0], [0, 0.1, 0], [0.1, 0, 0.005], [0.1, 0.1, 0.005], [0.1, 0, -0.005], [0.1, 0.1, -0.005]])
    larger, _ = inflate_hull(wedge, 0.002)
    assert larger[:, 0].min() >= -0.004 - 1e-9


def test_normals_of_a_hull_point_outwards():
    vertices, faces, normals = convex_hull(np.concatenate([corners(1, 1, 1), np.zeros((1, 3))]))
    assert len(vertices) == 8  # the one inside is gone
    a, b, c = vertices[faces].transpose(1, 0, 2)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), normals) > 0).all()


def decode(stream: list[int], voxel: float) -> set[tuple[int, int, int]]:
    """Decode a stream to the integer coordinates of its occupied voxels; check that all of it is read."""
    data = np.array(stream, dtype=np.int8).view("<u2").tolist()
    found, position = set(), 0

    def read(depth: int, x: int, y: int, z: int) -> None:
        nonlocal position
        mask, position = data[position], position + 1
        size = 1 << (DEPTH - 1 - depth)
        for child in range(8):
            state = mask >> (2 * child) & 3
            corner = (x + size * (child & 1), y + size * (child >> 1 & 1), z + size * (child >> 2))
            if state == 3:
                read(depth + 1, *corner)
            elif state == 2:
                assert size == 1
                found.add(corner)

    read(0, *[-(1 << (DEPTH - 1))] * 3)
    assert position == len(data)
    return found


def test_stream_contains_the_voxels_of_the_points():
    points, voxel = np.random.default_rng(0).uniform(-2, 2, (500, 3)), 0.01
    half = voxel * (1 << (DEPTH - 1))
    edges = [[half - 0.005] * 3, [0.005 - half] * 3]
    points = np.concatenate([points, points[:50] + 1e-5, [[0, 0, 0]], edges])
    expected = {tuple(key) for key in np.floor(points / voxel).astype(int).tolist()}
    outside = np.array([[half + 0.005, 0, 0], [0, -half - 0.005, 0], [0, 0, 1e300], [2 * half, 0, 0]])  # dropped
    assert decode(encode_octree(np.concatenate([outside, points]), voxel), voxel) == expected
    assert encode_octree(outside, voxel) == encode_octree(np.zeros((0, 3)), voxel) == []
