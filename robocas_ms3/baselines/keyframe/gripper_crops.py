"""Crops of a point cloud in the TCP frame, seen from the palm: input of the grasp network."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import Array

CELLS, CELL = 40, 0.004
"""Cells per side of a crop, and the width of a cell in m."""
CROP_CHANNELS, POSE_FEATURES = 3, 8
_DEPTH = 0.12  # m before and behind the TCP, along the approach
_NOTHING = 1.2  # distance in cells without a point
_SCALE = 10.0  # per m


def make_crops(
    points: Array, target: NDArray[np.floating], tcp_in_base: Array, table: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the crops and the pose features of G grasps.

    Args:
        points: (P, 3) points in the arm's base frame, m.
        target: (P,) probability that each point is on the object to grasp.
        tcp_in_base: (G, 4, 4) TCP poses of the grasps.
        table: height of the surface in the arm's base frame, m.

    Returns:
        Crops (G, 3, N, N): distance of the surface from the TCP along the approach in units of 10 cm, whether a point
        is in the cell, and the probability of the object. Pose features (G, 8).
    """
    count, size = len(tcp_in_base), CELLS * CELLS
    rotations, positions = tcp_in_base[:, :3, :3], tcp_in_base[:, :3, 3]
    radius = float(np.hypot(CELLS * CELL / np.sqrt(2), _DEPTH))
    center = positions.mean(axis=0) if count else np.zeros(3)
    reach = radius + (np.linalg.norm(positions - center, axis=1).max() if count else 0.0)
    near = np.linalg.norm(points - center, axis=1) < reach
    local = np.einsum("gpi,gij->gpj", points[near][None] - positions[:, None], rotations)
    columns = np.floor(local[..., :2] / CELL).astype(np.int64) + CELLS // 2
    inside = ((columns >= 0) & (columns < CELLS)).all(axis=-1) & (np.abs(local[..., 2]) < _DEPTH)
    grasp, point = np.nonzero(inside)
    depths = local[grasp, point, 2]
    order = np.argsort(-depths, kind="stable")  # the point nearest to the palm is written last
    cell = (grasp * size + columns[grasp, point, 0] * CELLS + columns[grasp, point, 1])[order]
    surface = np.full(count * size, _NOTHING, np.float32)
    known, probability = np.zeros(count * size, np.float32), np.zeros(count * size, np.float32)
    surface[cell] = _SCALE * depths[order]
    known[cell], probability[cell] = 1.0, target[near][point[order]]
    crops = np.stack([surface, known, probability]).reshape(3, count, CELLS, CELLS).swapaxes(0, 1)
    return crops, _make_pose_features(rotations, positions, table)


def _make_pose_features(rotations: Array, positions: Array, table: float) -> NDArray[np.float32]:
    approach, closing = rotations[:, :, 2], rotations[:, :, 1]
    distance = np.hypot(positions[:, 0], positions[:, 1])
    outward = (approach[:, :2] * positions[:, :2]).sum(axis=1) / np.maximum(distance, 0.1)
    height = (positions[:, 2] - table) * 8
    return np.stack(
        [
            approach[:, 2],
            closing[:, 2],
            height,
            positions[:, 0],
            positions[:, 1],
            distance,
            outward,
            rotations[:, 2, 0],
        ],
        axis=1,
    ).astype(np.float32)


def augment_crops(
    crops: NDArray[np.float32], poses: NDArray[np.float32], rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return randomly changed copies of crops (G, 3, N, N) and pose features (G, 8).

    Half a turn about the approach axis and reflections leave the outcome unchanged. The other changes are noise of the
    distances, missing cells, and shifts by up to one cell.
    """
    crops, poses = crops.astype(np.float32), poses.copy()
    if rng.random() < 0.5:  # half a turn
        crops, poses[:, [1, 7]] = crops[:, :, ::-1, ::-1], -poses[:, [1, 7]]
    if rng.random() < 0.5:  # reflection at the plane through the arm's base; the closing axis is reversed
        crops, poses[:, [1, 4]] = crops[:, :, :, ::-1], -poses[:, [1, 4]]
    crops = crops.copy()
    crops[:, 0] += rng.normal(0, 0.02, (len(crops), 1, 1)) + rng.normal(0, 0.02, crops[:, 0].shape)
    missing = rng.random(crops[:, 0].shape) < 0.05
    for channel, value in enumerate((_NOTHING, 0.0, 0.0)):
        crops[:, channel][missing] = value
    shift = rng.integers(-1, 2, size=2)
    return np.roll(crops, shift, axis=(2, 3)), poses
