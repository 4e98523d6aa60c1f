"""Joint motions that keep the gripper and a held object clear of observed points."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import islice
from typing import TypeVar

import numpy as np
from scipy.spatial import KDTree

from robocas_ms3.baselines.keyframe.motion import ArmPaths
from robocas_ms3.core.poses import Array, inverse, transform_points
from robocas_ms3.scenes.grasp_checks import is_gripper_clear

T = TypeVar("T")
_CELL = 0.015  # m, greatest distance between points on a surface
_CHECKED = 3  # every third configuration of a path is checked
_START = 0.06  # m from the start of a path, within which contact is allowed: the gripper leaves what it has touched
_CANDIDATES = 12  # goals that are tried
_CLEARANCE, _HELD_CLEARANCE = 0.005, 0.02  # m around the gripper, and around the visible side of a held object
_SAME_OBJECT = 0.025  # m from the points of an object, within which other points are on it or under it


class FreePaths:
    """Joint motions that keep the gripper and a held object clear of observed points; the arm is not checked.

    Args:
        paths: kinematics of the arm.
        rest: (7,) configuration through which a motion goes if the direct one is not clear, rad.
    """

    def __init__(self, paths: ArmPaths, rest: Array) -> None:
        self._paths, self._rest = paths, rest
        self._points: Array = np.zeros((0, 3))
        self._held: Array = np.zeros((0, 3))  # in the TCP frame

    def set_points(self, points: Array) -> None:
        """Set the points (P, 3) to avoid in the arm's base frame, m."""
        self._points = _thin_out(points)

    def hold(self, points: Array, grasp: Array) -> None:
        """Move an object with points (P, 3) together with the gripper that grasps it at a TCP pose (4, 4)."""
        if len(self._points) and len(points):
            distance, _ = KDTree(points).query(self._points, distance_upper_bound=_SAME_OBJECT)
            self._points = self._points[~np.isfinite(distance)]
            self._held = transform_points(inverse(grasp), _thin_out(points))

    def release(self) -> None:
        """Move the gripper without an object."""
        self._held = np.zeros((0, 3))

    def find_path(self, qpos: Array, goal: Array, *, by_rest: bool = False) -> Array | None:
        """Return a clear path (n, 7) from a configuration (7,) to another one, or None.

        by_rest: whether the path has to go through the rest configuration.
        """
        direct = self._paths.joint(qpos, goal)
        if not by_rest and self.is_clear(direct):
            return direct
        detour = self._find_detour(qpos, goal)
        return detour if self.is_clear(detour) else None

    def _find_detour(self, qpos: Array, goal: Array) -> Array:
        return np.concatenate([self._paths.joint(qpos, self._rest), self._paths.joint(self._rest, goal)])

    def choose(
        self, qpos: Array, candidates: Iterable[T], start_of: Callable[[T], Array], *, by_rest: bool = False
    ) -> tuple[T, Array] | None:
        """Return the first candidate to whose start a clear path (n, 7) leads, and the path.

        Without a clear path, the first candidate and the path to it are returned; without a candidate, None.

        Args:
            qpos: (7,) present configuration.
            candidates: candidates, the best first.
            start_of: returns the start configuration (7,) of a candidate.
            by_rest: whether the path has to go through the rest configuration.
        """
        first: T | None = None
        for candidate in islice(candidates, _CANDIDATES):
            path = self.find_path(qpos, start_of(candidate), by_rest=by_rest)
            if path is not None:
                return candidate, path
            first = candidate if first is None else first
        if first is None:
            return None
        to_first = self._find_detour if by_rest else self._paths.joint
        return first, to_first(qpos, start_of(first))

    def is_clear(self, path: Array, start: float = _START) -> bool:
        """Return whether the gripper and a held object keep clear of the points on a path (n, 7).

        start: m from the first pose, within which contact is allowed.
        """
        if not len(self._points) or not len(path):
            return True
        poses = self._paths.chain.tcp(np.concatenate([path[:-1:_CHECKED], path[-1:]]))
        away = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1) >= start
        clear = bool(is_gripper_clear(poses[away], self._points, _CLEARANCE).all())
        if clear and len(self._held) and away.any():
            held = np.concatenate([transform_points(pose, self._held) for pose in poses[away]])
            clear = KDTree(self._points).query(held, distance_upper_bound=_HELD_CLEARANCE)[0].min() == np.inf
        return clear


def _thin_out(points: Array) -> Array:
    cells = np.floor(points / _CELL).astype(np.int64)
    return points[np.unique(cells, axis=0, return_index=True)[1]]
