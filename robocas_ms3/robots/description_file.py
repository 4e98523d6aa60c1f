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
        name, kind: attributes ``name`` and ``type`` of the element.
        parent, child: names of the connected links.
        origin: (4, 4) pose of the joint frame in the frame of the parent link, m.
        axis: (3,) unit vector in the joint frame; x if the file has no axis, and for fixed joints.
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
        root: root element of the file.

    Raises:
        RobotDescriptionError: the file is missing or is not XML.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise RobotDescriptionError(
                "no such URDF or SRDF file", where=self.path, fix="Correct the path, or write the file."
            )
        try:
            self.root = ElementTree.parse(self.path).getroot()
        except ElementTree.ParseError as error:
            raise self.make_error("the URDF or SRDF file is not valid XML", "XML", error) from error

    def make_error(self, what: str, expected: object, found: object) -> RobotDescriptionError:
        return RobotDescriptionError(what, where=self.path, expected=expected, found=found, fix=REPAIR_FILE)

    def read_attribute(self, element: Element, key: str) -> str:
        if key not in element.attrib:
            found = " ".join(f'{name}="{value}"' for name, value in element.attrib.items()) or "no attributes"
            raise self.make_error(f"<{element.tag}> has no attribute {key!r}", key, found)
        return element.attrib[key]

    def read_numbers(self, element: Element, key: str, count: int, default: str | None = None) -> list[float]:
        """Return the ``count`` finite numbers of the attribute ``key`` of an element.

        If the attribute is missing, ``default`` is used as its text.
        """
        text = self.read_attribute(element, key) if default is None else element.attrib.get(key, default)
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            numbers = []
        if len(numbers) != count or not np.isfinite(numbers).all():
            noun = "finite number" if count == 1 else "finite numbers"
            raise self.make_error(f"invalid attribute {key!r} of <{element.tag}>", f"{count} {noun}", repr(text))
        return numbers

    def read_origin(self, element: Element) -> Array:
        """Return the pose (4, 4) in the child ``<origin>`` of an element; the identity without it."""
        pose, origin = np.eye(4), element.find("origin")
        if origin is not None:
            pose[:3, :3] = Rotation.from_euler("xyz", self.read_numbers(origin, "rpy", 3, "0 0 0")).as_matrix()
            pose[:3, 3] = self.read_numbers(origin, "xyz", 3, "0 0 0")
        return pose

    def joints(self) -> list[Joint]:
        """Return all joints in the order of the file."""
        return [self._joint(element) for element in self.root.iterfind("joint")]

    def joints_between(self, root: str, tip: str) -> list[Joint]:
        """Return the joints from link ``root`` to link ``tip``, in this order, with fixed joints."""
        by_child, found, link = {joint.child: joint for joint in self.joints()}, [], tip
        while link != root:
            if link not in by_child:
                expected, gap = f"joints from link {root!r} to link {tip!r}", f"no joint with the child {link!r}"
                raise self.make_error("no chain of joints between two links", expected, gap)
            joint = by_child.pop(link)
            found.append(joint)
            link = joint.parent
        return found[::-1]

    def _joint(self, element: Element) -> Joint:
        name, kind = self.read_attribute(element, "name"), self.read_attribute(element, "type")
        found = element.find("axis")
        axis = np.array([1.0, 0.0, 0.0] if found is None or kind == "fixed" else self.read_numbers(found, "xyz", 3))
        if not axis.any():
            raise self.make_error(f"invalid axis of joint {name!r}", "a vector other than zero", "0 0 0")
        return Joint(
            name=name,
            kind=kind,
            parent=self._link(element, "parent"),
            child=self._link(element, "child"),
            origin=self.read_origin(element),
            axis=axis / np.linalg.norm(axis),
            limits=self._limits(element),
        )

    def _link(self, joint: Element, tag: str) -> str:
        element = joint.find(tag)
        if element is None:
            raise self.make_error(f"joint {self.read_attribute(joint, 'name')!r} has no <{tag}>", f"<{tag}>", "none")
        return self.read_attribute(element, "link")

    def _limits(self, joint: Element) -> tuple[float, float] | None:
        limit = joint.find("limit")
        if limit is None or "lower" not in limit.attrib or "upper" not in limit.attrib:
            return None
        return self.read_numbers(limit, "lower", 1)[0], self.read_numbers(limit, "upper", 1)[0]


def tcp_and_arm_base_poses(spec: RobotSpec, root_in_world: Array, qpos: Array) -> tuple[Array, Array]:
    """Compute the poses of the TCP and of the arm's base in the world frame, (T, 4, 4) each.

    Dataset actions are computed from recorded states with this function, because equal states give bitwise equal
    poses. Link poses of the simulator would differ with and without a renderer.

    Args:
        spec: the robot.
        root_in_world: (T, 4, 4) pose of the root link.
        qpos: (T, 12) joint positions, m and rad.
    """
    urdf, robot = spec.files().urdf, spec.description
    base = root_in_world @ chain_poses(urdf, robot.root_link, robot.arm_base_link, qpos[:, robot.base_slice])
    return base @ chain_poses(urdf, robot.arm_base_link, robot.tcp_link, qpos[:, robot.arm_slice]), base


def chain_poses(urdf: Path, root: str, tip: str, positions: Array) -> Array:
    """Compute the poses (T, 4, 4) of link ``tip`` in the frame of link ``root``.

    Args:
        urdf: the file.
        root, tip: names of the links.
        positions: (T, n) positions of the n movable joints from root to tip, m or rad.
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
    """Read the joints of a URDF from link ``root`` to link ``tip``, in this order, with fixed joints."""
    return tuple(RobotXml(urdf).joints_between(root, tip))
