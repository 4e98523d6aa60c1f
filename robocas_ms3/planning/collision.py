"""Check an arm for self-collisions and collisions with obstacles and a held object.

A broad phase in NumPy compares axis-aligned boxes of parts and obstacles for whole batches of configurations. FCL
(python-fcl) checks only the pairs whose boxes overlap.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import fcl
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.planning.collision_geometry import BASE, TCP, read_collision_parts, read_link_pairs
from robocas_ms3.planning.kinematics import ArmChain
from robocas_ms3.planning.protocol import Array, AttachedBody, Obstacle
from robocas_ms3.planning.shapes import CollisionShapes, ConvexPieces
from robocas_ms3.robots.description import RobotDescription

CLOUD, ATTACHED = "cloud", "attached"
REACH = 1.5  # m from the arm's base; obstacle points beyond it are ignored
BASE_MARGIN = 0.015  # m around the fixed parts; points of a cloud closer than this are removed
SPARSE = 12  # every SPARSE-th configuration of a path is checked first
CHUNK = 128  # configurations of a path per batch


class CollisionChecker:
    """Collision model of the arm, the obstacles and the held object.

    Poses and points are in the arm's base frame. `protocol.Planner` documents the methods without a docstring. Each
    instance owns its FCL objects, so instances in different threads are independent.

    Args:
        urdf: URDF of the arm alone, with the arm's base as its root link.
        srdf: SRDF with the pairs of links that need no collision check.
        robot: description of the robot.

    Raises:
        RobotDescriptionError: a file is missing or unusable, or a geometry is not supported.
    """

    def __init__(self, urdf: Path | str, srdf: Path | str, robot: RobotDescription) -> None:
        self.chain = ArmChain(urdf, robot)
        self._open_width = self._finger_width = robot.open_width
        self._shapes = CollisionShapes()
        self._request, self._result = fcl.CollisionRequest(), fcl.CollisionResult()
        self._held = False
        self._pieces: list[tuple[ConvexPieces, int, Array]] = []
        self._obstacles: dict[int, Any] = {}  # FCL object by index of the piece, created when first needed
        # the held object is the last part, without a geometry until it is attached
        parts = read_collision_parts(urdf, self.chain)
        held, pairs = len(parts), read_link_pairs(urdf, srdf, parts)
        self._names = [*(part.link for part in parts), ATTACHED]
        self._frames = np.array([*(part.frame for part in parts), TCP])
        self._poses = np.array([*(part.pose for part in parts), np.eye(4)])
        self._slides = np.array([*(part.slide for part in parts), np.zeros(3)])
        self._parts: list[Any] = [fcl.CollisionObject(part.geometry, _fcl_pose(part.pose)) for part in parts]
        self._parts.append(None)
        open_finger, empty = robot.open_width / 2, np.zeros((2, 3))
        self._closed_bounds = np.array([*(part.bounds(0.0) for part in parts), empty])  # (P, 2, 3)
        self._open_bounds = np.array([*(part.bounds(open_finger) for part in parts), empty])
        self._moving = np.flatnonzero(self._frames != BASE)
        # the held object is fixed to link 7, hand and fingers, and its hull may touch them
        others = (robot.arm_base_link, robot.base_link, *robot.arm_links[:-1])
        self._own_pairs = len(pairs)  # without the held object
        self._pairs = np.array([*pairs, *((i, held) for i, part in enumerate(parts) if part.link in others)], dtype=int)
        self.set_scene([])

    @property
    def finger_width(self) -> float:
        return self._finger_width

    @finger_width.setter
    def finger_width(self, width: float) -> None:
        self._finger_width = float(np.clip(width, 0.0, self._open_width))

    def tcp(self, qpos: Array) -> Array:
        return self.chain.tcp(np.asarray(qpos, dtype=np.float64)[None])[0]

    def set_scene(self, obstacles: Sequence[Obstacle] | Array) -> None:
        bodies: list[tuple[str, ConvexPieces, Array]] = []
        if isinstance(obstacles, np.ndarray):
            points = np.asarray(obstacles, dtype=np.float64).reshape(-1, 3)
            points = np.ascontiguousarray(points[self.is_obstacle_point(points)])
            if len(points):
                bodies = [(CLOUD, self._shapes.cloud_pieces(points), np.eye(4))]
        else:  # bodies are not checked against the robot base
            bodies = [(o.name, self._shapes.obstacle_pieces(o.shape, o.clearance), o.pose_in_base) for o in obstacles]
        for index, placed in self._obstacles.items():
            pieces, piece, _ = self._pieces[index]
            pieces.unused[piece].append(placed)
        self._obstacles = {}
        self._obstacle_names = [name for name, pieces, _ in bodies for _ in pieces.geometries]
        self._pieces = [(pieces, piece, pose) for _, pieces, pose in bodies for piece in range(len(pieces.geometries))]
        low: list[Array] = [np.zeros((0, 3))]
        high: list[Array] = [np.zeros((0, 3))]
        for _, pieces, pose in bodies:
            vertices = pieces.vertices @ pose[:3, :3].T + pose[:3, 3]
            low.append(np.minimum.reduceat(vertices, pieces.first))
            high.append(np.maximum.reduceat(vertices, pieces.first))
        self._low, self._high = np.concatenate(low), np.concatenate(high)

    def is_obstacle_point(self, points: Array) -> NDArray[np.bool_]:
        """Return a mask (P,) of the points (P, 3) of a cloud that are obstacles.

        Obstacles are in reach and outside the robot's base.
        """
        keep = np.einsum("ij,ij->i", points, points) <= REACH**2
        for low, high in self._closed_bounds[self._frames == BASE]:
            keep &= ~np.all((points >= low - BASE_MARGIN) & (points <= high + BASE_MARGIN), axis=1)
        return keep

    def attach(self, body: AttachedBody | None) -> None:
        self._held = body is not None
        if body is None:
            return
        pieces = self._shapes.hull_pieces(body.vertices)
        if not pieces.unused[0]:
            pieces.unused[0].append(fcl.CollisionObject(pieces.geometries[0]))
        self._parts[-1] = pieces.unused[0][0]
        pose = self._poses[-1] = np.asarray(body.object_in_tcp, dtype=np.float64)
        vertices = pieces.vertices @ pose[:3, :3].T + pose[:3, 3]
        self._closed_bounds[-1] = self._open_bounds[-1] = vertices.min(axis=0), vertices.max(axis=0)

    def is_free(self, qpos: Array, finger_width: float | None = None) -> NDArray[np.bool_]:
        qpos = np.asarray(qpos, dtype=np.float64).reshape(-1, 7)
        width = self._open_width if finger_width is None else finger_width
        return np.array([next(found, None) is None for found in self._pairs_in_contact(qpos, width, True)], dtype=bool)

    def count_leading_free(self, qpos: Array, *, obstacles: bool = True) -> int:
        """Return the number of configurations of a path (M, 7) before the first one that collides.

        Without ``obstacles`` only self-collisions are checked.
        """
        for first in range(0, len(qpos), CHUNK):
            chunk = qpos[first : first + CHUNK]
            for row, found in enumerate(self._pairs_in_contact(chunk, self.finger_width, obstacles)):
                if next(found, None) is not None:
                    return first + row
        return len(qpos)

    def is_path_free(self, qpos: Array, *, obstacles: bool = True) -> bool:
        """Return whether all configurations of a path (M, 7) are collision-free.

        Every SPARSE-th configuration is checked first, since most collisions span several configurations. Without
        ``obstacles`` only self-collisions are checked.
        """
        if len(qpos) > 2 * SPARSE:
            qpos = np.concatenate([qpos[i::SPARSE] for i in (SPARSE - 1, *range(SPARSE - 1))])
            first = len(qpos) // SPARSE
            if self.count_leading_free(qpos[:first], obstacles=obstacles) < first:
                return False
            qpos = qpos[first:]
        return self.count_leading_free(qpos, obstacles=obstacles) == len(qpos)

    def find_collisions(self, qpos: Array, finger_width: float | None = None) -> list[str]:
        width = self._open_width if finger_width is None else finger_width
        found = next(self._pairs_in_contact(np.asarray(qpos, dtype=np.float64)[None], width, True))
        return sorted({name for pair in found for name in pair})

    def _pairs_in_contact(self, qpos: Array, width: float, obstacles: bool) -> Iterator[Iterator[tuple[str, str]]]:
        """Yield one lazy iterator per configuration (M, 7) over the pairs of names that collide there."""
        assert np.isfinite(qpos).all(), "NaN would compare as collision-free"
        if not len(qpos):
            return
        rotations, positions = self.chain.link_frames(qpos)
        links, others = self._broad_phase(rotations, positions, width, obstacles)
        if not len(links) and not len(others):
            yield from (iter(()) for _ in qpos)
            return
        rotations, positions = self._compute_part_poses(rotations, positions, width)
        link_ends, other_ends = (np.searchsorted(found[:, 0], np.arange(len(qpos) + 1)) for found in (links, others))
        for row in range(len(qpos)):
            own = links[link_ends[row] : link_ends[row + 1], 1].tolist()
            pieces = others[other_ends[row] : other_ends[row + 1], 1:].tolist()
            yield self._narrow_phase(own, pieces, rotations[:, row], positions[:, row])

    def _narrow_phase(
        self, links: list[int], others: list[list[int]], rotations: Array, positions: Array
    ) -> Iterator[tuple[str, str]]:
        """Yield the names of colliding pairs (FCL), for parts at rotations (P, 3, 3) and positions (P, 3)."""
        names, placed = self._names, set()

        def part(index: int) -> Any:
            found = self._parts[index]
            if index not in placed and self._frames[index] != BASE:  # setting a transform takes as long as a check
                placed.add(index)
                found.setTransform(fcl.Transform(rotations[index], positions[index]))
            return found

        for pair in links:
            a, b = self._pairs[pair].tolist()
            if self._is_in_contact(part(a), part(b)):
                yield names[a], names[b]
        for index, piece in others:
            if self._is_in_contact(part(index), self._get_obstacle(piece)):
                yield names[index], self._obstacle_names[piece]

    def _is_in_contact(self, a: Any, b: Any) -> bool:
        if not fcl.collide(a, b, self._request, self._result):
            return False
        self._result.contacts.clear()  # python-fcl appends to the contacts of earlier checks
        return True

    def _get_obstacle(self, index: int) -> Any:
        if index not in self._obstacles:
            pieces, piece, pose = self._pieces[index]
            unused = pieces.unused[piece]
            found = self._obstacles[index] = unused.pop() if unused else fcl.CollisionObject(pieces.geometries[piece])
            found.setTransform(_fcl_pose(pose))
        return self._obstacles[index]

    def _compute_part_poses(self, rotations: Array, positions: Array, width: float) -> tuple[Array, Array]:
        """Return rotations (P, M, 3, 3) and positions (P, M, 3) of parts from those of frames (8, M, ...)."""
        turned = rotations[self._frames]  # BASE indexes the last frame; its values are not used
        offsets = self._poses[:, :3, 3] + self._slides * (width / 2)
        placed = np.einsum("pmij,pj->pmi", turned, offsets) + positions[self._frames]
        return np.einsum("pmij,pjk->pmik", turned, self._poses[:, :3, :3]), placed

    def _broad_phase(
        self, rotations: Array, positions: Array, width: float, obstacles: bool
    ) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """Return the pairs whose boxes overlap, for frames at rotations (8, M, 3, 3) and positions (8, M, 3).

        Returns:
            Indices (n, 2) of configuration and pair of parts, and (m, 3) of configuration, part and obstacle piece.
        """
        bounds = self._closed_bounds + (self._open_bounds - self._closed_bounds) * (width / self._open_width)
        moving = self._moving if self._held else self._moving[:-1]
        frames, count = self._frames[moving], rotations.shape[1]
        turned = rotations[frames]  # (P, M, 3, 3)
        center, half = (bounds[moving, 0] + bounds[moving, 1]) / 2, (bounds[moving, 1] - bounds[moving, 0]) / 2
        at = positions[frames] + np.einsum("pmij,pj->pmi", turned, center)
        extent = np.einsum("pmij,pj->pmi", np.abs(turned), half)
        low, high = np.empty((2, len(bounds), count, 3))
        low[:], high[:] = bounds[:, 0, None], bounds[:, 1, None]
        low[moving], high[moving] = at - extent, at + extent
        a, b = (self._pairs if self._held else self._pairs[: self._own_pairs]).T
        links = np.argwhere(np.all((low[a] <= high[b]) & (low[b] <= high[a]), axis=2).T)
        if not obstacles or not len(self._low):
            return links, np.zeros((0, 3), dtype=int)
        low, high = low[moving], high[moving]
        near = np.all((self._low <= high.max(axis=(0, 1))) & (self._high >= low.min(axis=(0, 1))), axis=1)
        pieces = np.flatnonzero(near)
        overlap = np.ones((count, len(moving), len(pieces)), dtype=bool)
        for axis in range(3):
            overlap &= low[:, :, axis].T[:, :, None] <= self._high[pieces, axis]
            overlap &= high[:, :, axis].T[:, :, None] >= self._low[pieces, axis]
        found = np.argwhere(overlap)
        found[:, 1], found[:, 2] = moving[found[:, 1]], pieces[found[:, 2]]
        return links, found


def _fcl_pose(pose: Array) -> Any:
    return fcl.Transform(pose[:3, :3], pose[:3, 3])
