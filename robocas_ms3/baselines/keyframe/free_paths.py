"""Joint motions that keep the gripper clear of observed points."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import islice
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.baselines.keyframe.motion import ArmPaths
from robocas_ms3.scenes.grasp_checks import is_gripper_clear

Array = NDArray[np.float64]
T = TypeVar("T")
_CELL = 0.015  # m, greatest distance between points on a surface
_CHECKED = 3  # every third configuration of a path is checked
_START = 0.06  # m from the start of a path, within which contact is allowed: the gripper leaves what it has touched
_CANDIDATES = 12  # goals that are tried
_CLEARANCE = 0.005  # m


class FreePaths:
    """Joint motions that keep the gripper clear of observed points; the arm is not checked.

    Args:
        paths: kinematics of the arm.
        rest: (7,) configuration through which a motion goes if the direct one is not clear, rad.
    """

    def __init__(self, paths: ArmPaths, rest: Array) -> None:
        self._paths, self._rest = paths, rest
        self._points: Array = np.zeros((0, 3))

    def set_points(self, points: Array) -> None:
        """Set the points (P, 3) to avoid in the arm's base frame, m."""
        cells = np.floor(points / _CELL).astype(np.int64)
        self._points = points[np.unique(cells, axis=0, return_index=True)[1]]

    def find_path(self, qpos: Array, goal: Array) -> Array | None:
        """Return a clear path (n, 7) from a configuration (7,) to another one, or None."""
        direct = self._paths.joint(qpos, goal)
        if self._is_clear(direct):
            return direct
        detour = np.concatenate([self._paths.joint(qpos, self._rest), self._paths.joint(self._rest, goal)])
        return detour if self._is_clear(detour) else None

    def choose(self, qpos: Array, candidates: Iterable[T], start_of: Callable[[T], Array]) -> tuple[T, Array] | None:
        """Return the first candidate to whose start a clear path (n, 7) leads, and the path.

        Without a clear path, the first candidate and the direct path are returned; without a candidate, None.

        Args:
            qpos: (7,) present configuration.
            candidates: candidates, the best first.
            start_of: returns the start configuration (7,) of a candidate.
        """
        first: T | None = None
        for candidate in islice(candidates, _CANDIDATES):
            path = self.find_path(qpos, start_of(candidate))
            if path is not None:
                return candidate, path
            first = candidate if first is None else first
        return None if first is None else (first, self._paths.joint(qpos, start_of(first)))

    def _is_clear(self, path: Array) -> bool:
        if not len(self._points):
            return True
        poses = self._paths.chain.tcp(np.concatenate([path[:-1:_CHECKED], path[-1:]]))
        away = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1) > _START
        return bool(is_gripper_clear(poses[away], self._points, _CLEARANCE).all())
