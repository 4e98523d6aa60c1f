"""Compute forward kinematics of furniture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.manifest import Joint, Link

Array = NDArray[np.float64]


def joint_motion(joint: Joint, position: float) -> Array:
    """Return the motion (4, 4) of a link from joint position 0 to ``position`` (m or rad).

    The motion is in the frame of the furniture.
    """
    motion = np.eye(4)
    if joint.kind == "prismatic":
        motion[:3, 3] = np.multiply(joint.axis, position)
        return motion
    motion[:3, :3] = Rotation.from_rotvec(np.multiply(joint.axis, position)).as_matrix()
    motion[:3, 3] = joint.origin - motion[:3, :3] @ joint.origin
    return motion


def link_poses(links: Sequence[Link], positions: Mapping[str, float]) -> dict[str, Array]:
    """Return the pose (4, 4) of each link by name, in the frame of the furniture.

    Args:
        links: moving parts; a parent is listed before its children.
        positions: joint name -> position, m or rad; joints that are not listed are at 0.
    """
    poses: dict[str, Array] = {}
    for link in links:
        above = poses[link.parent] if link.parent else np.eye(4)
        poses[link.name] = above @ joint_motion(link.joint, positions.get(link.joint.name, 0.0))
    return poses


def joint_frame(joint: Joint) -> Array:
    """Return the pose (4, 4) of a joint in the furniture's frame: origin of the joint, x along its axis."""
    x = np.asarray(joint.axis, dtype=float)
    x = x / np.linalg.norm(x)
    y = np.cross(x, np.eye(3)[np.argmin(np.abs(x))])
    y /= np.linalg.norm(y)
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([x, y, np.cross(x, y)])
    frame[:3, 3] = joint.origin
    return frame
