"""Collision checking and kinematics of one arm in its base frame, on mplib 0.1.1's FCL and Pinocchio.

mplib's own ``Planner`` is not used. Its traps that are closed here: numpy 2 ends in a segmentation fault (refused
first); the voxel size of the cloud is the point spacing; the base pose stays at the origin, since attached bodies
ignore it; the cloud is an object like any other, so no flag can be forgotten; an attached body is checked against the
cloud, the links and what carries the arm.
"""

from __future__ import annotations

import hashlib
import itertools
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.errors import RobocasError
from robocas_ms3.planning.protocol import Array, AttachedBody

ARM_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("panda_finger_joint1", "panda_finger_joint2")
TCP_LINK = "panda_hand_tcp"
BASE_LINK = "panda_link0"
STATIC_LINKS = (BASE_LINK, "base_link")  # the second one, what carries the arm, may be missing
CLOUD = "cloud"
REACH = 1.5  # m; obstacle points further from the arm's base never matter
BASE_MARGIN = 0.015  # m around the parts that never move within which points of the cloud are cut out
CLOUDS_KEPT = 4  # trees of the last clouds; policies switch between a few of them


def require_numpy_1() -> None:
    """Refuse numpy 2, under which mplib 0.1.1 dies without a message.

    Raises:
        RobocasError: numpy is 2 or newer.
    """
    if int(np.__version__.split(".", maxsplit=1)[0]) >= 2:
        raise RobocasError(
            "mplib 0.1.1 crashes under this version",
            where="numpy",
            expected="< 2",
            found=np.__version__,
            fix="Run: pip install 'numpy>=1.26,<2'.",
        )


def pose_to_matrix(pose: Array) -> Array:
    """Turn (7,) x, y, z, qw, qx, qy, qz into a 4x4 matrix."""
    w, x, y, z = pose[3:] / np.linalg.norm(pose[3:])
    matrix = np.eye(4)
    matrix[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    matrix[:3, 3] = pose[:3]
    return matrix


def matrix_to_pose(matrix: Array) -> Array:
    """Turn a 4x4 matrix into (7,) x, y, z, qw, qx, qy, qz."""
    m = matrix[:3, :3]
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    # Bar-Itzhack's symmetric form, one row of 4 q q^T, chosen by its largest diagonal element: stable everywhere.
    diagonal = np.array([1 + trace, *(1 - trace + 2 * np.diag(m))])
    row = int(np.argmax(diagonal))
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    wxyz = np.array(
        ((diagonal[0], wx, wy, wz), (wx, diagonal[1], xy, xz), (wy, xy, diagonal[2], yz), (wz, xz, yz, diagonal[3]))
    )
    quaternion = wxyz[row] / np.linalg.norm(wxyz[row])
    return np.concatenate([matrix[:3, 3], quaternion])


class ArmWorld:
    """The arm, the obstacles and the held object.

    Args:
        urdf: the arm alone, rooted at ``panda_link0``.
        srdf: its pairs of links that may touch.
        voxel: edge of the cloud's voxels = spacing of its points, m.

    Raises:
        RobocasError: numpy 2, a missing file, or a link or joint is missing.
    """

    def __init__(self, urdf: Path | str, srdf: Path | str, *, voxel: float = 0.005) -> None:
        require_numpy_1()
        for path in (urdf, srdf):
            if not Path(path).is_file():
                raise RobocasError("no such robot description", where=path)
        from mplib.pymp import ArticulatedModel, PlanningWorld
        from mplib.pymp.collision_detection import fcl

        self._fcl, self._voxel = fcl, voxel
        try:
            self._robot = ArticulatedModel(
                str(urdf), str(srdf), np.array([0, 0, -9.81]), [], [], convex=True, verbose=False
            )
        except ValueError as error:
            raise RobocasError(
                "mplib can't load this description",
                where=urdf,
                expected="meshes by relative path, each with its hull beside it (NAME.convex.stl)",
                found=str(error).splitlines()[0],
            ) from error
        self.kinematics = self._robot.get_pinocchio_model()
        links, joints = self.kinematics.get_link_names(), self.kinematics.get_joint_names()
        missing = [name for name in (BASE_LINK, TCP_LINK) if name not in links]
        missing += [name for name in ARM_JOINTS if name not in joints]
        if missing:
            raise RobocasError("the description lacks links or joints", where=urdf, expected=", ".join(missing))
        self._robot.set_move_group(TCP_LINK)
        self.tcp_index = links.index(TCP_LINK)
        self.arm_indices = np.array([joints.index(name) for name in ARM_JOINTS])
        self._fingers = np.array([joints.index(name) for name in FINGER_JOINTS if name in joints], dtype=int)
        self.state_size = len(joints)
        self.limits = np.concatenate(self.kinematics.get_joint_limits())[self.arm_indices]
        self.checks = 0  # collision checks so far
        self.finger_width = 0.08

        model = self._robot.get_fcl_model()
        names, objects = model.get_collision_link_names(), model.get_collision_objects()
        self._robot.set_qpos(np.zeros(self.state_size), True)
        parts = list(zip(names, objects, strict=True))
        self._cut = [_bounds(part) for name, part in parts if name in STATIC_LINKS]
        self._bare = PlanningWorld([self._robot], ["robot"], [], [])
        self._world = PlanningWorld([self._robot], ["robot"], [], [])
        # The hand, the fingers and link 7 are rigid with the held object, whose hull may touch them.
        hittable = {*STATIC_LINKS, *(f"panda_link{i}" for i in range(7))}
        self._body_may_hit = [(name, part) for name, part in parts if name in hittable]
        self._request = fcl.CollisionRequest()
        self._trees: OrderedDict[bytes, Any] = OrderedDict()
        self._cloud: Any = None
        self._body: Any = None
        self._object_in_tcp = np.eye(4)

    def _full(self, qpos: Array, finger_width: float) -> Array:
        state = np.zeros(self.state_size)
        state[self.arm_indices] = qpos
        state[self._fingers] = finger_width / 2
        return state

    def full_qpos(self, qpos: Array) -> Array:
        """Fill the 7 arm joints (7,) up to all joints of the description."""
        return self._full(qpos, self.finger_width)

    def arm_qpos(self, state: Array) -> Array:
        """Take the 7 arm joints out of all joints of the description."""
        return np.asarray(state)[self.arm_indices]

    def tcp(self, qpos: Array) -> Array:
        """Give the TCP's pose in the base frame (4x4) at arm joints (7,)."""
        self.kinematics.compute_forward_kinematics(self.full_qpos(qpos))
        return pose_to_matrix(np.asarray(self.kinematics.get_link_pose(self.tcp_index)))

    def set_points(self, points_in_base: Array) -> None:
        """Replace the cloud by points (P, 3); those in the robot's own base or out of reach are dropped."""
        points = np.asarray(points_in_base, dtype=np.float64).reshape(-1, 3)
        if not np.isfinite(points).all():
            raise RobocasError("obstacle points must be finite", where="set_scene")
        points = np.ascontiguousarray(points[self.keeps(points)])
        if self._cloud is not None:
            self._world.remove_normal_object(CLOUD)
            self._cloud = None
        if len(points) == 0:
            return
        key = hashlib.blake2b(points.data).digest()
        self._cloud = self._trees.pop(key, None) or self._fcl.CollisionObject(self._fcl.OcTree(points, self._voxel))
        self._trees[key] = self._cloud
        if len(self._trees) > CLOUDS_KEPT:
            self._trees.popitem(last=False)
        self._world.set_normal_object(CLOUD, self._cloud)

    def keeps(self, points: Array) -> NDArray[np.bool_]:
        """Say which points (P, 3) count as obstacles: in reach, and not where the robot's own base stands."""
        keep = np.linalg.norm(points, axis=1) <= REACH
        for low, high in self._cut:
            keep &= ~np.all((points >= low - BASE_MARGIN) & (points <= high + BASE_MARGIN), axis=1)
        return keep

    def attach(self, body: AttachedBody | None) -> None:
        """Attach the convex hull of a held object to the TCP, or nothing."""
        if body is None:
            self._body = None
            return
        from scipy.spatial import ConvexHull

        vertices = np.asarray(body.vertices, dtype=np.float64)
        hull = ConvexHull(vertices)
        outward = np.einsum("ij,ij->i", _normals(vertices, hull.simplices), hull.equations[:, :3]) > 0
        faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
        used, faces = np.unique(faces, return_inverse=True)
        geometry = self._fcl.Convex(vertices[used], faces.reshape(-1, 3).astype(np.int32))
        self._object_in_tcp = np.asarray(body.object_in_tcp, dtype=np.float64)
        self._body = self._fcl.CollisionObject(geometry)

    def free(self, qpos: Array, *, cloud: bool = True) -> bool:
        """Say whether a configuration (7,) touches nothing; without ``cloud`` only robot and held object count."""
        self.checks += 1
        self._robot.set_qpos(self._full(qpos, self.finger_width), True)
        if (self._world if cloud else self._bare).collide():
            return False
        return self._body is None or not self._body_touches(cloud=cloud)

    def contacts(self, qpos: Array, finger_width: float) -> list[str]:
        """Name what touches at a configuration (7,): links, 'cloud', 'attached'."""
        self._robot.set_qpos(self._full(qpos, finger_width), True)
        names: set[str] = set()
        for hit in self._world.collide_full():
            names.update((hit.link_name1, hit.link_name2))
        if self._body is not None:
            names.update(self._body_touches(cloud=True))
        return sorted(names)

    def _body_touches(self, *, cloud: bool) -> list[str]:
        """Name what the held object touches, with 'attached' itself; the joints are set already."""
        tcp = pose_to_matrix(np.asarray(self.kinematics.get_link_pose(self.tcp_index)))
        self._body.set_transformation(matrix_to_pose(tcp @ self._object_in_tcp))
        others = self._body_may_hit + ([(CLOUD, self._cloud)] if cloud and self._cloud is not None else [])
        hits = [name for name, item in others if self._fcl.collide(self._body, item, self._request).is_collision()]
        return [*hits, "attached"] if hits else []


def _normals(vertices: Array, faces: NDArray[np.int_]) -> Array:
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return np.cross(b - a, c - a)


def _bounds(part: Any) -> tuple[Array, Array]:
    """Give the box around a collision object in the base frame: low and high corner (3,), m."""
    geometry = part.get_collision_geometry()
    if hasattr(geometry, "get_vertices"):
        vertices = np.array(geometry.get_vertices())
    else:
        vertices = np.array(geometry.side) / 2 * np.array(list(itertools.product((-1, 1), repeat=3)))
    points = vertices @ np.array(part.get_rotation()).T + np.array(part.get_translation())
    return points.min(axis=0), points.max(axis=0)
