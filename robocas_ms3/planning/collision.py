"""Collision checking and kinematics of one arm in its base frame, on mplib 0.1.1's FCL and Pinocchio.

Whole batches of configurations go through a broad phase in numpy, boxes along the axes around links and obstacles; only
pairs whose boxes overlap are given to FCL. mplib's ``PlanningWorld`` asks FCL for every pair of link and obstacle.

mplib's own ``Planner`` is not used. Its traps that are closed here: numpy 2 ends in a segmentation fault (refused
first); the voxel size of the cloud is the point spacing; the base pose stays at the origin, since attached bodies
ignore it; the cloud is an object like any other, so no flag can be forgotten; an attached body is checked against the
obstacles, the links and what carries the arm.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.errors import RobocasError
from robocas_ms3.planning.chain import ArmChain
from robocas_ms3.planning.protocol import Array, AttachedBody, Obstacle
from robocas_ms3.planning.shapes import CollisionShapes, Pieces, bounds, matrix_to_pose
from robocas_ms3.robots.description import RobotDescription

CLOUD, ATTACHED = "cloud", "attached"
REACH = 1.5  # m; obstacle points further from the arm's base never matter
BASE_MARGIN = 0.015  # m around the parts that never move within which points of the cloud are cut out
SPARSE = 12  # every so manieth configuration of a path is checked before all others
CHUNK = 128  # configurations of a path checked at once


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


@dataclass(frozen=True)
class _Pairs:
    """Pairs of parts and obstacles whose boxes overlap, by configuration.

    Attributes:
        links: (n, 2) configuration and pair of parts.
        obstacles: (m, 3) configuration, part and piece of an obstacle.
    """

    links: NDArray[np.int_]
    obstacles: NDArray[np.int_]

    def of(self, row: int) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """Pairs of parts (n, 1), and parts with pieces (m, 2), of one configuration."""
        a, b = np.searchsorted(self.links[:, 0], (row, row + 1))
        c, d = np.searchsorted(self.obstacles[:, 0], (row, row + 1))
        return self.links[a:b, 1:], self.obstacles[c:d, 1:]


class ArmWorld:
    """The arm, the obstacles and the held object.

    Args:
        urdf: the arm alone, rooted at its base.
        srdf: its pairs of links that may touch.
        robot: whose arm it is.
        voxel: edge of the cloud's voxels = spacing of its points, m.

    Raises:
        RobocasError: numpy 2, a missing file, or a link or joint is missing.
    """

    def __init__(self, urdf: Path | str, srdf: Path | str, robot: RobotDescription, *, voxel: float = 0.005) -> None:
        require_numpy_1()
        for path in (urdf, srdf):
            if not Path(path).is_file():
                raise RobocasError("no such robot description", where=path)
        from mplib.pymp import ArticulatedModel
        from mplib.pymp.collision_detection import fcl

        self._fcl, self._shapes = fcl, CollisionShapes(fcl, voxel)
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
        self.chain = ArmChain(urdf, robot)
        self.kinematics = self._robot.get_pinocchio_model()
        links, joints = self.kinematics.get_link_names(), self.kinematics.get_joint_names()
        self._robot.set_move_group(robot.tcp_link)
        self.tcp_index = links.index(robot.tcp_link)
        self.arm_indices = np.array([joints.index(name) for name in robot.arm_joints])
        self._fingers = np.array([joints.index(name) for name in robot.finger_joints if name in joints], dtype=int)
        self.state_size = len(joints)
        self.limits = np.concatenate(self.kinematics.get_joint_limits())[self.arm_indices]
        self.checks = 0  # configurations checked so far
        self.open_width = self.finger_width = robot.open_width
        self._request = fcl.CollisionRequest()
        self._object_in_tcp = np.eye(4)
        self._body: Any = None
        self._read_parts()
        self.set_obstacles([])

    def _read_parts(self) -> None:
        """Find each part's box in the frame of the link that carries it, and which parts may touch each other."""
        model, robot = self._robot.get_fcl_model(), self.chain.robot
        static = (robot.arm_base_link, robot.base_link)  # what carries the arm may be missing
        self._names: list[str] = [*model.get_collision_link_names(), ATTACHED]
        self._parts: list[Any] = [*model.get_collision_objects(), None]
        body = len(self._parts) - 1
        carriers = dict.fromkeys(static, -1) | {link: i for i, link in enumerate(robot.arm_links)}
        self._carrier = np.array([carriers.get(name, 7) for name in self._names])  # 7: what is rigid with the TCP
        rotations, positions = self.chain.frames(np.zeros((1, 7)))
        frames = [*zip(rotations[:, 0], positions[:, 0], strict=True), (np.eye(3), np.zeros(3))]
        boxes = []
        for width in (0.0, self.open_width):
            self._robot.set_qpos(self._full(np.zeros(7), width), True)
            boxes.append([bounds(part, *frames[c]) for part, c in zip(self._parts[:-1], self._carrier, strict=False)])
            boxes[-1].append(np.zeros((2, 3)))
        self._box, self._box_opened = np.array(boxes[0]), np.array(boxes[1])  # (parts, 2, 3) closed, open
        self._moving = np.flatnonzero(self._carrier >= 0)
        self._cut = self._box[self._carrier < 0]
        # The hand, the fingers and link 7 are rigid with the held object, whose hull may touch them.
        hittable = [i for i, name in enumerate(self._names[:-1]) if name in (*static, *robot.arm_links[:-1])]
        self._own_pairs = len(model.get_collision_pairs())  # without the held object
        self._pairs = np.array([*model.get_collision_pairs(), *((i, body) for i in hittable)])

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
        return self.chain.tcp(np.asarray(qpos, dtype=np.float64)[None])[0]

    def set_points(self, points_in_base: Array) -> None:
        """Replace the obstacles by points (P, 3); those in the robot's own base or out of reach are dropped."""
        points = np.asarray(points_in_base, dtype=np.float64).reshape(-1, 3)
        if not np.isfinite(points).all():
            raise RobocasError("obstacle points must be finite", where="set_scene")
        points = np.ascontiguousarray(points[self.keeps(points)])
        if len(points) == 0:
            self.set_obstacles([])
            return
        self._place([(CLOUD, self._shapes.cloud(points), np.eye(4))])

    def set_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Replace the obstacles by rigid bodies; they don't count against the robot's own base."""
        self._place([(o.name, self._shapes.obstacle(o.shape, o.room), o.pose_in_base) for o in obstacles])

    def _place(self, bodies: list[tuple[str, Pieces, Array]]) -> None:
        self._obstacle_names = [name for name, pieces, _ in bodies for _ in pieces.geometries]
        self._geometries = [(geometry, pose) for _, pieces, pose in bodies for geometry in pieces.geometries]
        self._objects: list[Any] = [None] * len(self._geometries)  # made when first asked for
        low, high = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for _, pieces, pose in bodies:
            vertices = pieces.vertices @ pose[:3, :3].T + pose[:3, 3]
            low.append(np.minimum.reduceat(vertices, pieces.first))
            high.append(np.maximum.reduceat(vertices, pieces.first))
        self._low, self._high = np.concatenate(low), np.concatenate(high)

    def _obstacle(self, index: int) -> Any:
        if self._objects[index] is None:
            self._objects[index] = self._shapes.object(*self._geometries[index])
        return self._objects[index]

    def keeps(self, points: Array) -> NDArray[np.bool_]:
        """Say which points (P, 3) count as obstacles: in reach, and not where the robot's own base stands."""
        keep = np.einsum("ij,ij->i", points, points) <= REACH**2
        for low, high in self._cut:
            keep &= ~np.all((points >= low - BASE_MARGIN) & (points <= high + BASE_MARGIN), axis=1)
        return keep

    def attach(self, body: AttachedBody | None) -> None:
        """Attach the convex hull of a held object to the TCP, or nothing."""
        self._body = None
        if body is None:
            return
        pieces = self._shapes.hull(body.vertices)
        self._object_in_tcp = np.asarray(body.object_in_tcp, dtype=np.float64)
        self._body = self._parts[-1] = self._shapes.object(pieces.geometries[0])
        vertices = pieces.vertices @ self._object_in_tcp[:3, :3].T + self._object_in_tcp[:3, 3]
        self._box[-1] = self._box_opened[-1] = vertices.min(axis=0), vertices.max(axis=0)

    def free(self, qpos: Array, *, obstacles: bool = True, finger_width: float | None = None) -> NDArray[np.bool_]:
        """Say which configurations (M, 7) touch nothing; without ``obstacles`` only robot and held object count."""
        width = self.finger_width if finger_width is None else finger_width
        return np.array([not any(True for _ in hits) for hits in self._hits(qpos, width, obstacles)], dtype=bool)

    def free_until(self, qpos: Array, *, obstacles: bool = True) -> int:
        """How many configurations of a path (M, 7) touch nothing before the first one that does."""
        for first in range(0, len(qpos), CHUNK):
            for row, hits in enumerate(self._hits(qpos[first : first + CHUNK], self.finger_width, obstacles)):
                if any(True for _ in hits):
                    return first + row
        return len(qpos)

    def all_free(self, qpos: Array, *, obstacles: bool = True) -> bool:
        """Say whether all configurations of a path (M, 7) touch nothing; sparse ones first, where failures show."""
        if len(qpos) > 2 * SPARSE:
            qpos = np.concatenate([qpos[i::SPARSE] for i in (SPARSE - 1, *range(SPARSE - 1))])
            first = len(qpos) // SPARSE
            if self.free_until(qpos[:first], obstacles=obstacles) < first:
                return False
            qpos = qpos[first:]
        return self.free_until(qpos, obstacles=obstacles) == len(qpos)

    def contacts(self, qpos: Array, finger_width: float) -> list[str]:
        """Name what touches at a configuration (7,): links, obstacles, 'attached'."""
        hits = next(iter(self._hits(np.asarray(qpos, dtype=np.float64)[None], finger_width, True)))
        return sorted({name for pair in hits for name in pair})

    def _hits(self, qpos: Array, width: float, obstacles: bool) -> Iterator[Iterator[tuple[str, str]]]:
        """For each configuration (M, 7) in turn the names of what touches, pair by pair, as far as one asks."""
        self.checks += len(qpos)
        if not len(qpos):
            return
        rotations, positions, body = *self.chain.frames(qpos), len(self._parts) - 1
        pairs = self._overlapping(rotations, positions, width, obstacles)
        for row in range(len(qpos)):
            links, others = pairs.of(row)
            if not len(links) and not len(others):
                yield iter(())
                continue
            self._robot.set_qpos(self._full(qpos[row], width), True)
            if body in others[:, 0] or (self._pairs[links[:, 0], 1] == body).any():
                tcp = np.eye(4)
                tcp[:3, :3], tcp[:3, 3] = rotations[7, row], positions[7, row]
                self._body.set_transformation(matrix_to_pose(tcp @ self._object_in_tcp))
            yield self._touching(links, others)

    def _touching(self, links: NDArray[np.int_], others: NDArray[np.int_]) -> Iterator[tuple[str, str]]:
        parts, names, collide, request = self._parts, self._names, self._fcl.collide, self._request
        for (pair,) in links.tolist():
            a, b = self._pairs[pair]
            if collide(parts[a], parts[b], request).is_collision():
                yield names[a], names[b]
        for part, piece in others.tolist():
            if collide(parts[part], self._obstacle(piece), request).is_collision():
                yield names[part], self._obstacle_names[piece]

    def _overlapping(self, rotations: Array, positions: Array, width: float, obstacles: bool) -> _Pairs:
        """The broad phase: links 1 to 7 and the TCP at rotations (8, M, 3, 3) and positions (8, M, 3)."""
        box = self._box + (self._box_opened - self._box) * (width / self.open_width)
        moving = self._moving if self._body is not None else self._moving[:-1]
        carrier, count = self._carrier[moving], rotations.shape[1]
        turned = rotations[carrier]  # (P, M, 3, 3)
        middle, half = (box[moving, 0] + box[moving, 1]) / 2, (box[moving, 1] - box[moving, 0]) / 2
        at = positions[carrier] + np.einsum("pmij,pj->pmi", turned, middle)
        reach = np.einsum("pmij,pj->pmi", np.abs(turned), half)
        low, high = np.empty((2, len(box), count, 3))
        low[:], high[:] = box[:, 0, None], box[:, 1, None]
        low[moving], high[moving] = at - reach, at + reach
        known = self._pairs if self._body is not None else self._pairs[: self._own_pairs]
        a, b = known.T
        touch = np.all((low[a] <= high[b]) & (low[b] <= high[a]), axis=2)
        links = np.argwhere(touch.T)
        if not obstacles or not len(self._low):
            return _Pairs(links, np.zeros((0, 3), dtype=int))
        low, high = low[moving], high[moving]
        near = np.all((self._low <= high.max(axis=(0, 1))) & (self._high >= low.min(axis=(0, 1))), axis=1)
        pieces = np.flatnonzero(near)
        first, last = self._low[pieces], self._high[pieces]
        overlap = np.ones((count, len(moving), len(pieces)), dtype=bool)
        for axis in range(3):
            overlap &= low[:, :, axis].T[:, :, None] <= last[:, axis]
            overlap &= high[:, :, axis].T[:, :, None] >= first[:, axis]
        found = np.argwhere(overlap)
        found[:, 1], found[:, 2] = moving[found[:, 1]], pieces[found[:, 2]]
        return _Pairs(links, found)
