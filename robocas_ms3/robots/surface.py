"""Points on the surface of a robot, for given joint positions."""

from __future__ import annotations

from xml.etree.ElementTree import Element

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from robocas_ms3.core.poses import Array, inverse, transform_points
from robocas_ms3.robots.description_file import Joint, RobotXml
from robocas_ms3.robots.registry import RobotSpec

_POINTS_PER_MESH = 400


class RobotSurface:
    """Points on the visual meshes of a robot, with normals.

    Args:
        robot: specification of the robot.

    Raises:
        RobotDescriptionError: the URDF is malformed, or a visual mesh cannot be read.
    """

    def __init__(self, robot: RobotSpec) -> None:
        self._description = robot.description
        xml = RobotXml(robot.files().urdf)
        self._joints = _sort_joints(xml.joints(), robot.description.root_link)
        self._links: dict[str, tuple[Array, Array]] = {}  # points and normals (P, 3) in the frame of each link
        for link in xml.root.iterfind("link"):
            parts = [
                _sample_mesh(xml, visual, mesh)
                for visual in link.iterfind("visual")
                if (mesh := visual.find("geometry/mesh")) is not None
            ]
            if parts:
                points, normals = zip(*parts, strict=True)
                self._links[xml.read_attribute(link, "name")] = np.concatenate(points), np.concatenate(normals)

    def compute_points(self, qpos: ArrayLike) -> tuple[Array, Array]:
        """Return points and outward normals, (P, 3) each, in the arm's base frame, m; none without visual meshes.

        qpos: (12,) joint positions of the robot (`RobotDescription`).
        """
        robot = self._description
        names = (*robot.base_joints, *robot.arm_joints, *robot.finger_joints)
        positions = dict(zip(names, np.asarray(qpos, np.float64).tolist(), strict=True))
        poses = {robot.root_link: np.eye(4)}
        for joint in self._joints:
            poses[joint.child] = poses[joint.parent] @ joint.origin @ _move_joint(joint, positions.get(joint.name, 0.0))
        to_base = inverse(poses[robot.arm_base_link])
        points: list[Array] = [np.zeros((0, 3))]
        normals: list[Array] = [np.zeros((0, 3))]
        for name, (on_link, normal) in self._links.items():
            pose = to_base @ poses[name]
            points.append(transform_points(pose, on_link))
            normals.append(normal @ pose[:3, :3].T)
        return np.concatenate(points), np.concatenate(normals)


def _sort_joints(joints: list[Joint], root: str) -> list[Joint]:
    """Return joints in an order in which each parent link comes before its child links."""
    found, links, rest = [], {root}, joints
    while following := [joint for joint in rest if joint.parent in links]:
        found += following
        links |= {joint.child for joint in following}
        rest = [joint for joint in rest if joint.child not in links]
    return found


def _move_joint(joint: Joint, position: float) -> Array:
    motion = np.eye(4)
    if joint.kind == "prismatic":
        motion[:3, 3] = position * joint.axis
    elif joint.kind != "fixed":
        motion[:3, :3] = Rotation.from_rotvec(position * joint.axis).as_matrix()
    return motion


def _sample_mesh(xml: RobotXml, visual: Element, element: Element) -> tuple[Array, Array]:
    """Return points and normals (P, 3) on the mesh of the element ``<mesh>`` of a visual, in the frame of the link."""
    name = xml.read_attribute(element, "filename")
    try:
        mesh = trimesh.load(xml.path.parent / name, force="mesh")
    except (OSError, ValueError, ImportError, NotImplementedError) as error:
        raise xml.make_error("cannot read a visual mesh", name, error) from error
    assert isinstance(mesh, trimesh.Trimesh)
    mesh.apply_scale(xml.read_numbers(element, "scale", 3, "1 1 1"))
    points, faces = trimesh.sample.sample_surface(mesh, _POINTS_PER_MESH, seed=0)[:2]
    origin = xml.read_origin(visual)
    return transform_points(origin, np.asarray(points)), mesh.face_normals[faces] @ origin[:3, :3].T
