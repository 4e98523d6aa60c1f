"""Which poses the arm can reach at all, and how: closed-form inverse kinematics over a grid of joint 7."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.extensions import load
from robocas_ms3.planning.chain import ArmChain, turn_between
from robocas_ms3.planning.protocol import Array

STEP = 0.25  # rad between turns of joint 7 that are tried for many poses
FINE_STEP = 0.1  # the same for one pose
DISTINCT = 0.3  # rad (norm over the joints) between two solutions that count as different
MOST = 40  # solutions of one pose


class Reachability:
    """Inverse kinematics of one arm; collisions do not count.

    Args:
        chain: the arm.

    Raises:
        RobocasError: the closed form that its robot names is not there, or for other arms.
    """

    def __init__(self, chain: ArmChain) -> None:
        self.chain = chain
        self.lower, self.upper = self.chain.lower, self.chain.upper
        self._geometry = load(self.chain.robot.inverse_kinematics)(self.chain)

    def reachable(self, tcp_in_base: Array, near: Array) -> tuple[NDArray[np.bool_], Array]:
        """Solve inverse kinematics for many poses at once.

        Args:
            tcp_in_base: (N, 4, 4).
            near: (7,) preferred configuration; of a pose's solutions the nearest is kept.

        Returns:
            (N,) whether a configuration inside the joint limits was found, and (N, 7) that one, NaN where none.
        """
        poses, near = np.asarray(tcp_in_base, dtype=np.float64).reshape(-1, 4, 4), np.asarray(near, dtype=np.float64)
        if len(poses) == 0:
            return np.zeros(0, dtype=bool), np.zeros((0, 7))
        found = self._solve(poses, near, STEP)
        away = np.where(np.isnan(found[..., 0]), np.inf, turn_between(found, near))
        best = away.argmin(axis=1)
        qpos = found[np.arange(len(poses)), best]
        return np.isfinite(qpos[:, 0]), qpos

    def everything(self, tcp_in_base: Array, near: Array) -> tuple[Array, NDArray[np.intp]]:
        """Give all configurations (M, 7) that reach many poses (N, 4, 4), and of which pose each is one (M,)."""
        found = self._solve(np.asarray(tcp_in_base, dtype=np.float64), np.asarray(near, dtype=np.float64), STEP)
        exists = np.isfinite(found[..., 0])
        return found[exists], np.nonzero(exists)[0]

    def solutions(self, tcp_in_base: Array, near: Array) -> list[Array]:
        """Give distinct configurations (7,) that reach one pose (4x4), nearest to ``near`` first."""
        found = self._solve(np.asarray(tcp_in_base, dtype=np.float64)[None], near, FINE_STEP)[0]
        found = found[np.isfinite(found[:, 0])]
        kept: list[Array] = []
        for qpos in found[np.argsort(turn_between(found, near), kind="stable")]:
            if all(np.linalg.norm(qpos - other) >= DISTINCT for other in kept):
                kept.append(qpos)
        return kept[:MOST]

    def _solve(self, poses: Array, near: Array, step: float) -> Array:
        """Solutions (N, K, 7) of poses (N, 4, 4) over joint 7, ``near``'s turn of it among those tried."""
        first, last = np.ceil((self.lower[6] - near[6]) / step), np.floor((self.upper[6] - near[6]) / step)
        turns = np.clip(near[6] + step * np.arange(first, last + 1), self.lower[6], self.upper[6])
        solved = self._geometry.solve(np.repeat(poses, len(turns), axis=0), np.tile(turns, len(poses)))
        return solved.reshape(len(poses), -1, 7)
