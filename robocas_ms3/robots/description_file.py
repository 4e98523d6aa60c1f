"""Read URDF and SRDF files, and compute link poses from a URDF without a simulator."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import RobotDescriptionError
from robocas_ms3.robots.registry import RobotSpec

Array = NDArray[np.float64]
REPAIR_FILE = "Correct the file, or export it again."


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint of a URDF.

    Attributes:
        name, kind: its ``name`` and ``type``.
        parent, child: names of the connected links.
        origin: (4, 4) pose of the joint's frame in the parent link's frame, m.
        axis: (3,) unit vector in the joint's frame; default: x.
        limits: lower and upper limit, rad or m; None if the file does not have both.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: Array
    axis: Array
    limits: tuple[float, float] | None


class RobotXml:
    """A parsed URDF or SRDF file.

    Every method raises ``RobotDescriptionError`` for a missing or invalid element, attribute or number.

    Args:
        path: the file.

    Attributes:
        path: the file.
        root: its root element.

    Raises:
        RobotDescriptionError: the file is missing or is not XML.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise RobotDescriptionError(
                "missing robot description", where=self.path, fix="Correct the path, or write the file."
            )
        try:
            self.root = ElementTree.parse(self.path).getroot()
        except ElementTree.ParseError as error:
            raise self.error("invalid robot description", "XML", error) from error

    def error(self, what: str, expected: object, found: object) -> RobotDescriptionError:
        return RobotDescriptionError(what, where=self.path, expected=expected, found=found, fix=REPAIR_FILE)

    def attribute(self, element: Element, key: str) -> str:
        if key not in element.attrib:
            found = " ".join(f'{name}="{value}"' for name, value in element.attrib.items()) or "no attributes"
            raise self.error(f"missing attribute of <{element.tag}>", key, found)
        return element.attrib[key]

    def numbers(self, element: Element, key: str, count: int, default: str | None = None) -> list[float]:
        """Return the ``count`` finite numbers of an attribute, or of ``default`` if the attribute is missing."""
        text = self.attribute(element, key) if default is None else element.attrib.get(key, default)
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            numbers = []
        if len(numbers) != count or not np.isfinite(numbers).all():
            noun = "finite number" if count == 1 else "finite numbers"
            raise self.error(f"invalid attribute {key!r} of <{element.tag}>", f"{count} {noun}", repr(text))
        return numbers

    def origin(self, element: Element) -> Array:
        """Return the pose (4, 4) of an element's ``origin``; the identity without one."""
        pose, origin = np.eye(4), element.find("origin")
        if origin is not None:
            pose[:3, :3] = Rotation.from_euler("xyz", self.numbers(origin, "rpy", 3, "0 0 0")).as_matrix()
            pose[:3, 3] = self.numbers(origin, "xyz", 3, "0 0 0")
        return pose

    def joints(self) -> list[Joint]:
        """Return all joints in file order."""
        return [self._joint(element) for element in self.root.iterfind("joint")]

    def joints_between(self, root: str, tip: str) -> list[Joint]:
        """Return the joints from link ``root`` to link ``tip`` in this order, including fixed joints."""
        by_child, found, link = {joint.child: joint for joint in self.joints()}, [], tip
        while link != root:
            if link not in by_child:
                raise self.error(
                    "no chain of joints between two links", f"joints from {root} to {tip}", f"no joint above {link}"
                )
            joint = by_child.pop(link)
            found.append(joint)
            link = joint.parent
        return found[::-1]

    def _joint(self, element: Element) -> Joint:
        found = element.find("axis")
        axis = np.array([1.0, 0.0, 0.0] if found is None else self.numbers(found, "xyz", 3))
        if not axis.any():
            raise self.error("invalid joint axis", "a vector that is not zero", repr(self.attribute(found, "xyz")))
        return Joint(
            name=self.attribute(element, "name"),
            kind=self.attribute(element, "type"),
            parent=self._link(element, "parent"),
            child=self._link(element, "child"),
            origin=self.origin(element),
            axis=axis / np.linalg.norm(axis),
            limits=self._limits(element),
        )

    def _link(self, joint: Element, tag: str) -> str:
        element = joint.find(tag)
        if element is None:
            raise self.error(f"incomplete joint {self.attribute(joint, 'name')!r}", f"<{tag}>", "none")
        return self.attribute(element, "link")

    def _limits(self, joint: Element) -> tuple[float, float] | None:
        limit = joint.find("limit")
        if limit is None or "lower" not in limit.attrib or "upper" not in limit.attrib:
            return None
        return self.numbers(limit, "lower", 1)[0], self.numbers(limit, "upper", 1)[0]


def tcp_and_arm_base_poses(spec: RobotSpec, root_in_world: Array, qpos: Array) -> tuple[Array, Array]:
    """Return the poses of the TCP and of the arm's base in the world frame, (T, 4, 4) each.

    Dataset actions are computed from recorded states with this function, since equal states give bitwise equal poses.
    Link poses of the simulator differ with and without a renderer.

    Args:
        spec: the robot.
        root_in_world: (T, 4, 4) pose of the root link.
        qpos: (T, 12) m, rad.
    """
    urdf, robot = spec.files().urdf, spec.description
    base = root_in_world @ chain_poses(urdf, robot.root_link, robot.arm_base_link, qpos[:, robot.base_slice])
    return base @ chain_poses(urdf, robot.arm_base_link, robot.tcp_link, qpos[:, robot.arm_slice]), base


def chain_poses(urdf: Path, root: str, tip: str, positions: Array) -> Array:
    """Return poses (T, 4, 4) of link ``tip`` in the frame of ``root`` at positions (T, n) of the movable joints."""
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
    """Read the joints from link ``root`` to link ``tip`` of a URDF in this order, including fixed joints."""
    return tuple(RobotXml(urdf).joints_between(root, tip))
