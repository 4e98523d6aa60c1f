"""Where to let go of an object: TCP poses that hold it above a container. Pure maths."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.planning.protocol import Array


def sample_drops(
    rng: np.random.Generator,
    *,
    count: int,
    container_in_base: Array,
    inner_low: Array,
    inner_high: Array,
    vertices_in_tcp: Array,
    center_in_tcp: Array,
    clearance: tuple[float, float] = (0.03, 0.07),
    max_tilt_deg: float = 70.0,
    spread: float = 0.25,
) -> Array:
    """Sample TCP poses at which a held object hangs above a container, its lowest point clear of the rim.

    The approach axis is tilted from straight down by up to ``max_tilt_deg`` (upstream: 30..70), away from the arm, so
    that far containers are within reach; half of the samples are steep, for near ones.

    Args:
        rng: source of all randomness.
        count: how many poses.
        container_in_base: 4x4.
        inner_low: (3,) least corner of the container's inside, in its frame, m.
        inner_high: (3,) greatest corner.
        vertices_in_tcp: (V, 3) the object's hull in the TCP frame, m.
        center_in_tcp: (3,) the object's centre of mass in the TCP frame, m.
        clearance: least and greatest height of the object's lowest point above the rim, m.
        max_tilt_deg: greatest tilt.
        spread: how far from the middle the centre of mass may be, as a share of the inside's half size.

    Returns:
        (count, 4, 4) TCP in the arm's base frame.
    """
    middle, half = (inner_low + inner_high) / 2, (inner_high - inner_low) / 2
    local = np.column_stack(
        [middle[:2] + rng.uniform(-spread, spread, (count, 2)) * half[:2], np.full(count, inner_high[2])]
    )
    above = local @ container_in_base[:3, :3].T + container_in_base[:3, 3]
    tilt = np.deg2rad(max_tilt_deg) * rng.uniform(0, 1, count) ** 2
    outward = np.arctan2(above[:, 1], above[:, 0]) + rng.uniform(-0.6, 0.6, count)
    roll = rng.uniform(-np.pi, np.pi, count)
    # straight down (z of the TCP = -z of the base) with a free turn, then tilted about the axis across ``outward``
    down = Rotation.from_euler("x", np.pi) * Rotation.from_euler("z", roll[:, None])
    across = np.column_stack([-np.sin(outward), np.cos(outward), np.zeros(count)])
    rotation = Rotation.from_rotvec(-across * tilt[:, None]) * down
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotation.as_matrix()
    lowest = (poses[:, 2, :3] @ vertices_in_tcp.T).min(axis=1)
    center = np.einsum("nij,j->ni", poses[:, :3, :3], center_in_tcp)
    poses[:, :2, 3] = above[:, :2] - center[:, :2]
    poses[:, 2, 3] = above[:, 2] + rng.uniform(*clearance, count) - lowest
    return poses


def overhangs(
    tcp_in_base: Array, container_in_base: Array, inner_low: Array, inner_high: Array, vertices_in_tcp: Array
) -> Array:
    """How far a held object sticks out sideways of the opening below it.

    Args:
        tcp_in_base: (n, 4, 4) poses of the TCP.
        container_in_base: 4x4.
        inner_low: (3,) least corner of the container's inside, in its frame, m.
        inner_high: (3,) greatest corner.
        vertices_in_tcp: (V, 3) the object's hull, m.

    Returns:
        (n,) m; 0 where it would fall straight in.
    """
    rotation, origin = container_in_base[:3, :3], container_in_base[:3, 3]
    points = np.einsum("nij,vj->nvi", tcp_in_base[:, :3, :3], vertices_in_tcp) + tcp_in_base[:, None, :3, 3]
    local = (points - origin) @ rotation
    return np.maximum(np.maximum(inner_low - local, local - inner_high)[..., :2].max(axis=(1, 2)), 0)
