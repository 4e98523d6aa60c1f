"""Encode voxels as octomap's binary tree stream, from which python-fcl builds an octree."""

from __future__ import annotations

import numpy as np

from robocas_ms3.planning.protocol import Array

DEPTH = 16  # levels of octomap's trees
OCCUPIED, INNER = 2, 3  # two bits per child; 0: unknown


def encode_octree(points: Array, voxel: float) -> list[int]:
    """Encode the voxels that contain points.

    A tree holds 2^16 voxels along each axis, centred at the origin; points outside of it are dropped.

    The stream lists the inner nodes depth first; each is 16 bits, two for each of its 8 children.

    Args:
        points: (P, 3), m.
        voxel: edge length of a voxel, m.

    Returns:
        Bytes as signed integers, as python-fcl expects them; empty where the tree contains no point.
    """
    keys = np.floor(points / voxel) + (1 << (DEPTH - 1))
    keys = keys[np.all((keys >= 0) & (keys < 1 << DEPTH), axis=1)].astype(np.int64)
    if not len(keys):
        return []
    codes = np.zeros(len(keys), dtype=np.int64)  # Morton order is the order of a depth-first traversal
    for bit in range(DEPTH):
        for axis in range(3):
            codes |= ((keys[:, axis] >> bit) & 1) << (3 * bit + axis)
    children = np.unique(codes)
    masks, codes_of_nodes, depths = [], [], []
    for depth in range(DEPTH - 1, -1, -1):
        parents, first_child = np.unique(children >> 3, return_index=True)
        state = OCCUPIED if depth == DEPTH - 1 else INNER
        masks.append(np.bitwise_or.reduceat(np.int64(state) << (2 * (children & 7)), first_child))
        codes_of_nodes.append(parents << (3 * (DEPTH - depth)))  # code of the node's first voxel
        depths.append(np.full(len(parents), depth))
        children = parents
    order = np.lexsort((np.concatenate(depths), np.concatenate(codes_of_nodes)))
    return np.concatenate(masks)[order].astype("<u2").view(np.int8).tolist()
