"""TCP poses that hold an object above a container. Pure maths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.planning.protocol import Array

CLEARANCE = (0.03, 0.07)  # m, least and greatest height of the object's lowest point above the rim
MAX_TILT_DEG = 70.0  # RoboCAS-v0: 30 to 70
SPREAD = 0.25  # of the inside's half size: how far from the middle the centre of mass may be


@dataclass(frozen=True)
class Inside:
    """The inside of a container, a box.

    Attributes:
        container_in_base: 4x4 of the container's frame in the arm's base frame.
        low: (3,) least corner in the container's frame, m.
        high: (3,) greatest corner.
    """

    container_in_base: Array
    low: Array
    high: Array


def sample_drops(rng: np.random.Generator, count: int, inside: Inside, vertices: Array, center_of_mass: Array) -> Array:
    """Sample TCP poses at which a held object hangs above a container, its lowest point clear of the rim.

    The approach axis is tilted from straight down, away from the arm, so that far containers are within reach; half of
    the samples are steep, for near ones.

    Args:
        rng: source of all randomness.
        count: how many poses.
        inside: of the container.
        vertices: (V, 3) the object's hull in the TCP frame, m.
        center_of_mass: (3,) the object's, in the TCP frame, m.

    Returns:
        (count, 4, 4) TCP in the arm's base frame.
    """
    middle, half = (inside.low + inside.high) / 2, (inside.high - inside.low) / 2
    local = np.column_stack(
        [middle[:2] + rng.uniform(-SPREAD, SPREAD, (count, 2)) * half[:2], np.full(count, inside.high[2])]
    )
    above = local @ inside.container_in_base[:3, :3].T + inside.container_in_base[:3, 3]
    tilt = np.deg2rad(MAX_TILT_DEG) * rng.uniform(0, 1, count) ** 2
    outward = np.arctan2(above[:, 1], above[:, 0]) + rng.uniform(-0.6, 0.6, count)
    roll = rng.uniform(-np.pi, np.pi, count)
    # straight down (z of the TCP = -z of the base) with a free turn, then tilted about the axis across ``outward``
    down = Rotation.from_euler("x", np.pi) * Rotation.from_euler("z", roll[:, None])
    across = np.column_stack([-np.sin(outward), np.cos(outward), np.zeros(count)])
    rotation = Rotation.from_rotvec(-across * tilt[:, None]) * down
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotation.as_matrix()
    lowest = (poses[:, 2, :3] @ vertices.T).min(axis=1)
    center = np.einsum("nij,j->ni", poses[:, :3, :3], center_of_mass)
    poses[:, :2, 3] = above[:, :2] - center[:, :2]
    poses[:, 2, 3] = above[:, 2] + rng.uniform(*CLEARANCE, count) - lowest
    return poses


def overhangs(tcp_in_base: Array, inside: Inside, vertices: Array, margin: float = 0.0) -> Array:
    """Return how far (n,) a held object sticks out sideways of the opening below it, m; 0 where it falls straight in.

    Args:
        tcp_in_base: (n, 4, 4) poses of the TCP.
        inside: of the container.
        vertices: (V, 3) the object's hull in the TCP frame, m.
        margin: by which the opening is narrower at each side, m.
    """
    rotation, origin = inside.container_in_base[:3, :3], inside.container_in_base[:3, 3]
    points = np.einsum("nij,vj->nvi", tcp_in_base[:, :3, :3], vertices) + tcp_in_base[:, None, :3, 3]
    local = (points - origin) @ rotation
    return np.maximum(
        np.maximum(inside.low + margin - local, local - inside.high + margin)[..., :2].max(axis=(1, 2)), 0
    )
