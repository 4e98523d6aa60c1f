"""Intrinsics and poses of cameras, for policies and datasets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import Array, inverse
from robocas_ms3.robots.cameras import Mount, Parent
from robocas_ms3.robots.description_file import chain_poses
from robocas_ms3.robots.registry import RobotSpec

OPENCV_IN_SAPIEN: Array = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
"""Pose of the OpenCV camera frame (x right, y down, z forward) in SAPIEN's (x forward, y left, z up)."""


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics and pose of a camera.

    Attributes:
        intrinsic: (4,) fx, fy, cx, cy in pixels.
        camera_in_parent: (4, 4) nominal pose of the OpenCV camera frame in the parent frame, as configured.
        parent: parent frame: the EEF, the arm base or the world.
        true_camera_in_parent: (4, 4) pose with the random motion of the camera (``randomisation.cameras``), from which
            images are rendered.
    """

    intrinsic: NDArray[np.float64]
    camera_in_parent: NDArray[np.float64]
    parent: Parent
    true_camera_in_parent: NDArray[np.float64]


def to_intrinsic_matrix(intrinsic: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the intrinsic matrix (3, 3) of fx, fy, cx, cy (4,)."""
    fx, fy, cx, cy = intrinsic.tolist()
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def find_mount_in_parent(robot: RobotSpec, mount: Mount) -> Array:
    """Return the constant pose (4, 4) of the link that carries a camera in the parent frame of the camera.

    The hand link is constant in the frame of the TCP, and the base link in the frame of the arm base.
    """
    spec, urdf = robot.description, robot.files().urdf
    if mount == "world":
        return np.eye(4)
    root, link, parent, joints = {
        "hand": (spec.arm_base_link, spec.hand_link, spec.tcp_link, len(spec.arm_joints)),
        "base": (spec.root_link, spec.base_link, spec.arm_base_link, len(spec.base_joints)),
    }[mount]
    at_zero = np.zeros((1, joints))
    return (inverse(chain_poses(urdf, root, parent, at_zero)) @ chain_poses(urdf, root, link, at_zero))[0]


def find_parent_in_base(parent: Parent, tcp_in_base: Array, arm_base_in_world: Array) -> Array:
    """Return the poses (..., 4, 4) of the parent frame of a camera in the arm's base frame.

    Args:
        parent: the parent frame.
        tcp_in_base: (..., 4, 4) TCP poses in the arm's base frame.
        arm_base_in_world: (..., 4, 4) poses of the arm's base in the world frame.
    """
    if parent == "ee":
        return tcp_in_base
    return np.broadcast_to(np.eye(4), tcp_in_base.shape) if parent == "arm_base" else inverse(arm_base_in_world)
