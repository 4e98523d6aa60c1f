"""Read the collision geometry of an arm from its URDF and the link pairs to check from its SRDF."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import fcl
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import RobotDescriptionError
from robocas_ms3.core.text import format_error
from robocas_ms3.planning.kinematics import ArmChain
from robocas_ms3.planning.protocol import Array
from robocas_ms3.planning.shapes import convex_hull, make_fcl_convex
from robocas_ms3.robots.description_file import Joint, RobotXml

BASE, TCP = -1, 7  # frames of parts; 0 to 6 are links 1 to 7
HULL_SUFFIX = ".convex.stl"  # suffix of the file with the convex hull of a mesh, next to the mesh


@dataclass(frozen=True)
class CollisionPart:
    """One convex collision geometry of a link.

    Attributes:
        link: name of the link.
        frame: frame to which the part is fixed: ``BASE``, 0 to 6 (links 1 to 7), or ``TCP``.
        pose: (4x4) pose of the part in ``frame`` with closed fingers.
        slide: (3,) displacement in ``frame`` per metre of finger position; zero for parts that no finger joint moves.
        geometry: FCL geometry.
        corners: (V, 3) points whose convex hull contains the part, in the part's frame, m.
    """

    link: str
    frame: int
    pose: Array
    slide: Array
    geometry: Any
    corners: Array

    def bounds(self, finger_position: float) -> Array:
        """Return the lower and upper corner (2, 3) of the part's bounding box in ``frame``, m.

        ``finger_position`` is the position of both finger joints, m; 0: closed.
        """
        points = self.corners @ self.pose[:3, :3].T + self.pose[:3, 3] + finger_position * self.slide
        return np.array([points.min(axis=0), points.max(axis=0)])


def read_collision_parts(urdf: Path | str, chain: ArmChain) -> list[CollisionPart]:
    """Read the collision parts of the arm's base link and of all links that descend from it.

    Joints other than arm and finger joints are at position 0.

    Raises:
        RobotDescriptionError: a link or mesh is missing or unusable, or a geometry is not supported.
    """
    robot, file = chain.robot, RobotXml(urdf)
    links = {file.read_attribute(link, "name"): link for link in file.root.iterfind("link")}
    joints_below: dict[str, list[Joint]] = {}
    for joint in file.joints():
        joints_below.setdefault(joint.parent, []).append(joint)
    link7_in_tcp = np.linalg.inv(chain.links[7])

    def visit(name: str, frame: int, pose: Array, slide: Array) -> Iterator[CollisionPart]:
        if name not in links:
            raise file.make_error("missing link", f'<link name="{name}">, the child of a joint', "none")
        for geometry, corners, origin in _read_collision_geometries(links[name], name, file):
            yield CollisionPart(name, frame, pose @ origin, slide, geometry, corners)
        if frame == 6:  # links that hang from link 7 are rigid with the TCP
            frame, pose = TCP, link7_in_tcp @ pose
        for joint in joints_below.get(name, []):
            if joint.child in robot.arm_links:
                yield from visit(joint.child, robot.arm_links.index(joint.child), np.eye(4), np.zeros(3))
                continue
            child_pose = pose @ joint.origin
            child_slide = slide
            if joint.name in robot.finger_joints:
                if joint.kind != "prismatic":
                    raise file.make_error(f"wrong type of finger joint {joint.name!r}", "type prismatic", joint.kind)
                child_slide = slide + child_pose[:3, :3] @ joint.axis
            yield from visit(joint.child, frame, child_pose, child_slide)

    return list(visit(robot.arm_base_link, BASE, np.eye(4), np.zeros(3)))


def read_link_pairs(urdf: Path | str, srdf: Path | str, parts: list[CollisionPart]) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of indices of ``parts`` that need a collision check.

    Pairs of the same link, of adjacent links, and of links that the SRDF disables are omitted.
    """
    ignored = {frozenset((joint.parent, joint.child)) for joint in RobotXml(urdf).joints()}
    file = RobotXml(srdf)
    for pair in file.root.iterfind("disable_collisions"):
        ignored.add(frozenset((file.read_attribute(pair, "link1"), file.read_attribute(pair, "link2"))))
    return [
        (i, j)
        for i, j in itertools.combinations(range(len(parts)), 2)
        if parts[i].link != parts[j].link and frozenset((parts[i].link, parts[j].link)) not in ignored
    ]


def _read_collision_geometries(link: Element, name: str, file: RobotXml) -> Iterator[tuple[Any, Array, Array]]:
    for collision in link.iterfind("collision"):
        origin = file.read_origin(collision)
        for shape in collision.iterfind("geometry/*"):
            geometry, corners = _read_geometry(shape, name, file)
            yield geometry, corners, origin


def _read_geometry(shape: Element, link: str, file: RobotXml) -> tuple[Any, Array]:
    if shape.tag == "mesh":
        scale = np.array(file.read_numbers(shape, "scale", 3, "1 1 1"))
        mesh = file.path.parent / file.read_attribute(shape, "filename")
        hull = mesh.with_name(mesh.name + HULL_SUFFIX)
        corners, faces = _read_hull(hull if hull.is_file() else mesh, scale, link)
        return make_fcl_convex(corners, faces), corners
    if shape.tag == "box":
        x, y, z = file.read_numbers(shape, "size", 3)
        return fcl.Box(x, y, z), _box_corners(x, y, z)
    if shape.tag == "cylinder":
        (radius,), (length,) = file.read_numbers(shape, "radius", 1), file.read_numbers(shape, "length", 1)
        return fcl.Cylinder(radius, length), _box_corners(2 * radius, 2 * radius, length)
    if shape.tag == "sphere":
        (radius,) = file.read_numbers(shape, "radius", 1)
        return fcl.Sphere(radius), _box_corners(2 * radius, 2 * radius, 2 * radius)
    what, expected = f"unsupported collision geometry of link {link!r}", "mesh, box, cylinder or sphere"
    raise file.make_error(what, expected, shape.tag)


def _box_corners(x: float, y: float, z: float) -> Array:
    return np.array(list(itertools.product((-x / 2, x / 2), (-y / 2, y / 2), (-z / 2, z / 2))))


def _read_hull(path: Path, scale: Array, link: str) -> tuple[Array, NDArray[np.int32]]:
    import trimesh

    try:
        mesh: Any = trimesh.load(path, force="mesh", process=False)
        corners, faces, _ = convex_hull(np.asarray(mesh.vertices, dtype=np.float64) * scale)
    except Exception as error:  # the loaders of trimesh raise different types; qhull rejects flat meshes
        raise RobotDescriptionError(
            f"unusable collision mesh of link {link!r}",
            where=path,
            expected="a mesh with positive volume in a format that trimesh reads, such as STL or OBJ",
            found=format_error(error),
            fix="Export the mesh again as STL.",
        ) from error
    return corners, faces
