"""Forward kinematics of the robot, from its URDF and in numpy: poses of recorded states without a simulator."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

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


@dataclass(frozen=True)
class Joint:
    """A joint of a URDF.

    Attributes:
        name, kind: its ``name`` and ``type``.
        origin: (4, 4) m, its frame in the parent link's.
        axis: (3,) in its own frame.
    """

    name: str
    kind: str
    origin: Array
    axis: Array


@lru_cache(maxsize=8)
def read_joints(urdf: Path, root: str, tip: str) -> list[Joint]:
    """Read the joints from one link of a URDF to another, fixed ones included, in this order."""
    by_child = {joint.find("child").attrib["link"]: joint for joint in ElementTree.parse(urdf).iterfind("joint")}  # type: ignore[union-attr]
    found: list[Joint] = []
    while tip != root:
        joint = by_child[tip]
        origin, axis = np.eye(4), joint.find("axis")
        at = joint.find("origin")
        if at is not None:
            origin[:3, 3] = _numbers(at.get("xyz", "0 0 0"))
            origin[:3, :3] = Rotation.from_euler("xyz", _numbers(at.get("rpy", "0 0 0"))).as_matrix()
        direction = _numbers("1 0 0" if axis is None else axis.attrib["xyz"])
        found.append(Joint(joint.attrib["name"], joint.attrib["type"], origin, direction))
        tip = joint.find("parent").attrib["link"]  # type: ignore[union-attr]
    return found[::-1]


def _numbers(text: str) -> Array:
    return np.array([float(word) for word in text.split()])
