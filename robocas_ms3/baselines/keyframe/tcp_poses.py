"""Alternative TCP poses for views of a point and for the release of an object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robocas_ms3.core.poses import Array, from_rotation, inverse

TOP_VIEWS_DEG = (90, 80, 70, 60, 50)
"""Elevations of the camera in views from above, degrees, the preferred one first."""
_RELEASE_TILTS_DEG, _RELEASE_SIDES = (0, 15, 30, 45, 60, 72), (0.0, -0.4, 0.4)  # degrees; rad about the vertical
_RELEASE_NEARER = (0.0, 0.05)  # m towards the base


def find_views(
    camera_in_tcp: Array,
    point: Array,
    distances: Sequence[float],
    elevations_deg: Sequence[float] = TOP_VIEWS_DEG,
) -> tuple[Array, Array]:
    """Return TCP poses whose camera views a point, and their costs.

    Args:
        camera_in_tcp: (4, 4) pose of the OpenCV camera frame in the TCP frame.
        point: (3,) point in the arm's base frame, m.
        distances: distances of the camera from the point, m.
        elevations_deg: elevations of the camera above the point, degrees.

    Returns:
        Poses (N, 4, 4) in the arm's base frame, and costs (N,): small for views at the first elevation.
    """
    poses, costs = [], []
    azimuth, tcp_in_camera = float(np.arctan2(point[1], point[0])), inverse(camera_in_tcp)
    for distance in distances:
        for elevation in elevations_deg:
            level, down = np.cos(np.deg2rad(elevation)), np.sin(np.deg2rad(elevation))
            for turn in (0.0,) if elevation == 90 else (0.0, 0.5, -0.5, 1.0, -1.0):
                forward = np.array([level * np.cos(azimuth + turn), level * np.sin(azimuth + turn), -down])
                for roll in (0.0, 0.4, -0.4, 0.8, -0.8):
                    up = np.array([np.cos(azimuth + roll), np.sin(azimuth + roll), 0.0])
                    up -= forward * (up @ forward)
                    if np.linalg.norm(up) < 0.1:
                        continue
                    up /= np.linalg.norm(up)
                    camera = from_rotation(
                        point - distance * forward, np.stack([np.cross(-up, forward), -up, forward], 1)
                    )
                    poses.append(camera @ tcp_in_camera)
                    costs.append(abs(elevations_deg[0] - elevation) * 0.01 + abs(roll) * 0.1 + abs(turn) * 0.1)
    return np.array(poses), np.array(costs)


def find_release_poses(point: Array, upright: Array | None = None) -> tuple[Array, Array]:
    """Return TCP poses at which the gripper may release an object, and their costs.

    The poses point down or are tilted away from the base, because a tilted gripper reaches farther.

    Args:
        point: (3,) TCP position in the arm's base frame, m.
        upright: (3,) axis in the TCP frame that was vertical at the grasp; None: any.

    Returns:
        Poses (N, 4, 4) in the arm's base frame, and costs (N,): small for vertical poses exactly at the point, or for
        poses in which the axis ``upright`` is vertical.
    """
    azimuth = float(np.arctan2(point[1], point[0]))
    away = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    poses, costs = [], []
    for tilt in _RELEASE_TILTS_DEG:
        for side in _RELEASE_SIDES:
            level = np.array([np.cos(azimuth + side), np.sin(azimuth + side), 0.0])
            approach = np.sin(np.deg2rad(tilt)) * level - np.array([0, 0, np.cos(np.deg2rad(tilt))])
            for turn in np.arange(0, 2 * np.pi, np.pi / 6):
                closing = np.array([np.cos(turn), np.sin(turn), 0.0])
                closing -= approach * (approach @ closing)
                if np.linalg.norm(closing) < 0.2:
                    continue
                closing /= np.linalg.norm(closing)
                rotation = np.stack([np.cross(closing, approach), closing, approach], axis=1)
                for nearer in _RELEASE_NEARER:
                    poses.append(from_rotation(point - nearer * away, rotation))
                    lean = 0.01 * tilt if upright is None else float(np.arccos(np.clip(rotation[2] @ upright, -1, 1)))
                    costs.append(lean + 4 * nearer)
    return np.array(poses), np.array(costs)
