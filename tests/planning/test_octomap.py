"""The octree stream, against a decoder written from octomap's format description."""

from __future__ import annotations

import numpy as np

from robocas_ms3.planning.octomap import DEPTH, encode_octree


def decode(stream: list[int], voxel: float) -> set[tuple[int, int, int]]:
    """Integer coordinates of the occupied voxels, and all of the stream is read."""
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
    points = np.concatenate([points, points[:50] + 1e-5, [[0, 0, 0]]])
    expected = {tuple(key) for key in np.floor(points / voxel).astype(int).tolist()}
    assert decode(encode_octree(points, voxel), voxel) == expected


def test_points_outside_of_the_tree_are_dropped():
    voxel, half = 0.01, 0.01 * (1 << (DEPTH - 1))
    inside = np.array([[0.005, 0.005, 0.005], [half - 0.005] * 3, [0.005 - half] * 3])
    outside = np.array([[half + 0.005, 0, 0], [0, -half - 0.005, 0], [0, 0, 1e300], [0, -1e300, 0], [2 * half, 0, 0]])
    expected = {(0, 0, 0), ((1 << (DEPTH - 1)) - 1,) * 3, (-(1 << (DEPTH - 1)),) * 3}
    assert decode(encode_octree(np.concatenate([outside, inside]), voxel), voxel) == expected
    assert encode_octree(outside, voxel) == []
    assert encode_octree(np.zeros((0, 3)), voxel) == []


def test_each_byte_is_a_signed_integer():
    stream = encode_octree(np.random.default_rng(1).uniform(-1, 1, (200, 3)), 0.01)
    assert all(isinstance(value, int) and -128 <= value <= 127 for value in stream)
