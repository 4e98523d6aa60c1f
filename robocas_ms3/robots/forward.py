"""Forward kinematics of the robot, from its URDF and in numpy: poses of recorded states without a simulator."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.robots.description_file import DescriptionFile, Joint
from robocas_ms3.robots.table import RobotSpec

Array = NDArray[np.float64]


def link_poses(spec: RobotSpec, root_in_world: Array, qpos: Array) -> tuple[Array, Array]:
    """Poses of the TCP and of the arm's base in the world, (T, 4, 4) each.

    Whatever makes dataset actions of recorded states goes this way: equal states give equal numbers to the last bit,
    with and without a renderer, which the links' poses of a simulator do not.

    Args:
        spec: the robot.
        root_in_world: (T, 4, 4) of its root.
        qpos: (T, 12) m, rad.
    """
    urdf, robot = spec.files().urdf, spec.description
    base = root_in_world @ chain(urdf, robot.root_link, robot.arm_base_link, qpos[:, robot.base_slice])
    return base @ chain(urdf, robot.arm_base_link, robot.tcp_link, qpos[:, robot.arm_slice]), base


def chain(urdf: Path, root: str, tip: str, positions: Array) -> Array:
    """Pose of a link in another one, (T, 4, 4).

    Args:
        urdf: the robot.
        root, tip: links.
        positions: (T, n) m or rad of the n moving joints between them, from the root on.
    """
    pose = np.tile(np.eye(4), (len(positions), 1, 1))
    columns = iter(np.asarray(positions, np.float64).T)
    for joint in read_joints(urdf, root, tip):
        pose = pose @ joint.origin
        if joint.kind == "fixed":
            continue
        along = next(columns)[:, None] * joint.axis
        motion = np.tile(np.eye(4), (len(positions), 1, 1))
        if joint.kind == "prismatic":
            motion[:, :3, 3] = along
        else:
            motion[:, :3, :3] = Rotation.from_rotvec(along).as_matrix()
        pose = pose @ motion
    return pose


@lru_cache(maxsize=8)
def read_joints(urdf: Path, root: str, tip: str) -> tuple[Joint, ...]:
    """Read the joints from one link of a URDF down to another, fixed ones included, in this order."""
    return tuple(DescriptionFile(urdf).joints_between(root, tip))
