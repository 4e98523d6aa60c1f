"""Inverse kinematics: in closed form for many poses, and numerically along a straight line of the TCP."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.core.extensions import load
from robocas_ms3.planning.chain import ArmChain, turn_between
from robocas_ms3.planning.protocol import Array

JOINT7_STEP = 0.25  # rad between turns of joint 7 that are tried for many poses
JOINT7_FINE_STEP = 0.1  # the same for one pose
DISTINCT = 0.3  # rad (norm over the joints) between two solutions that count as different
MOST = 40  # solutions of one pose
LINE_STEP = 0.01  # m between two poses of a straight line
LINE_TURN = np.deg2rad(3)  # rad between two poses of a straight line
MAX_JUMP = 0.15  # rad that a joint may turn between two poses of a straight line
STRIDE = 4  # poses between two first estimates
TOGETHER = 8  # Newton steps of all poses of a line together
IN_TURN = 60  # Newton steps of one pose
TOLERANCE = 1e-7  # accepted pose error, m and rad together
HALF_TURN = -0.99  # cosine below which a rotation counts as nearly a half turn
DAMPING = 1e-8  # added to the diagonal of J J^T, so that it can be inverted at singularities


class Reachability:
    """Inverse kinematics of one arm by the closed form that its description names; collisions do not count."""

    def __init__(self, chain: ArmChain) -> None:
        self.chain = chain
        self.lower, self.upper = self.chain.lower, self.chain.upper
        self._geometry = load(self.chain.robot.inverse_kinematics)(self.chain)

    def reachable(self, tcp_in_base: Array, near: Array) -> tuple[NDArray[np.bool_], Array]:
        """Find for each pose (N, 4, 4) the solution that is nearest to a configuration (7,).

        Returns:
            (N,) whether there is one inside the joint limits, and (N, 7) that one, NaN where none.
        """
        poses, near = np.asarray(tcp_in_base, dtype=np.float64).reshape(-1, 4, 4), np.asarray(near, dtype=np.float64)
        if len(poses) == 0:
            return np.zeros(0, dtype=bool), np.zeros((0, 7))
        found = self._solve(poses, near, JOINT7_STEP)
        away = np.where(np.isnan(found[..., 0]), np.inf, turn_between(found, near))
        best = away.argmin(axis=1)
        qpos = found[np.arange(len(poses)), best]
        return np.isfinite(qpos[:, 0]), qpos

    def everything(self, tcp_in_base: Array, near: Array) -> tuple[Array, NDArray[np.intp]]:
        """Give all configurations (M, 7) that reach many poses (N, 4, 4), and of which pose each is one (M,)."""
        found = self._solve(np.asarray(tcp_in_base, dtype=np.float64), np.asarray(near, dtype=np.float64), JOINT7_STEP)
        exists = np.isfinite(found[..., 0])
        return found[exists], np.nonzero(exists)[0]

    def solutions(self, tcp_in_base: Array, near: Array) -> list[Array]:
        """Give distinct configurations (7,) that reach one pose (4x4), nearest to ``near`` first."""
        found = self._solve(np.asarray(tcp_in_base, dtype=np.float64)[None], near, JOINT7_FINE_STEP)[0]
        found = found[np.isfinite(found[:, 0])]
        kept: list[Array] = []
        for qpos in found[np.argsort(turn_between(found, near), kind="stable")]:
            if all(np.linalg.norm(qpos - other) >= DISTINCT for other in kept):
                kept.append(qpos)
        return kept[:MOST]

    def _solve(self, poses: Array, near: Array, step: float) -> Array:
        """Return solutions (N, K, 7) of poses (N, 4, 4) over joint 7, which is also tried at its value in ``near``."""
        first, last = np.ceil((self.lower[6] - near[6]) / step), np.floor((self.upper[6] - near[6]) / step)
        turns = np.clip(near[6] + step * np.arange(first, last + 1), self.lower[6], self.upper[6])
        solved = self._geometry.solve(np.repeat(poses, len(turns), axis=0), np.tile(turns, len(poses)))
        return solved.reshape(len(poses), -1, 7)


def rotation_vector(rotations: Array) -> Array:
    """Return the rotation vectors (M, 3) in rad, of length up to pi, of rotation matrices (M, 3, 3)."""
    twice_sine_axis = rotations[:, (2, 0, 1), (1, 2, 0)] - rotations[:, (1, 2, 0), (2, 0, 1)]
    sine = np.sqrt(np.einsum("mi,mi->m", twice_sine_axis, twice_sine_axis)) / 2
    cosine = (np.einsum("mii->m", rotations) - 1) / 2
    angle = np.arctan2(sine, cosine)
    vectors = twice_sine_axis * (angle / (2 * np.maximum(sine, 1e-300)))[:, None]
    half_turns = cosine < HALF_TURN  # the sine vanishes there, and the axis with it
    if half_turns.any():
        vectors[half_turns] = Rotation.from_matrix(rotations[half_turns]).as_rotvec()
    return vectors


def newton_step(chain: ArmChain, qpos: Array, goals: Array) -> tuple[Array, Array]:
    """Move each configuration by one damped Newton step towards its own TCP pose, within the joint limits.

    The step has the smallest norm over the joints. It is computed without BLAS and LAPACK, whose last bits depend on
    the processor and on the number of threads.

    Args:
        qpos: (M, 7) rad.
        goals: (M, 4, 4) TCP poses in the base frame.

    Returns:
        The next configurations (M, 7), and the pose errors (M,) of the given ones: the norm over m and rad.
    """
    poses, jacobian = chain.jacobian(qpos)
    error = np.empty((len(qpos), 6))
    error[:, :3] = goals[:, :3, 3] - poses[:, :3, 3]
    error[:, 3:] = rotation_vector(np.einsum("mij,mkj->mik", goals[:, :3, :3], poses[:, :3, :3]))
    square = np.einsum("mij,mkj->mik", jacobian, jacobian)
    square[:, range(6), range(6)] += DAMPING
    step = np.einsum("mji,mj->mi", jacobian, solve_positive(square, error))
    return np.clip(qpos + step, chain.lower, chain.upper), np.sqrt(np.einsum("mi,mi->m", error, error))


def solve_positive(matrices: Array, values: Array) -> Array:
    """Solve positive definite systems (M, N, N) for (M, N) by Gauss-Jordan elimination without pivoting."""
    rows = np.concatenate([matrices, values[:, :, None]], axis=2)
    for pivot in range(rows.shape[1]):
        rows[:, pivot] /= rows[:, pivot, pivot, None]
        factors = rows[:, :, pivot].copy()
        factors[:, pivot] = 0.0
        rows -= factors[:, :, None] * rows[:, pivot, None, :]
    return rows[:, :, -1]


def follow_line(chain: ArmChain, start: Array, tcp_in_base: Array, *, stage: str) -> Array:
    """Follow a straight line of the TCP from a configuration (7,) to a pose (4, 4): linear position, shortest rotation.

    Returns:
        (n, 7) configurations whose TCP poses are at most 1 cm and 3 deg apart; the first is ``start``.

    Raises:
        PlanningFailed: ``line_unreachable``, or ``line_joint_jump``.
    """
    start = np.asarray(start, dtype=np.float64)
    goals = _line_poses(chain.tcp(start[None])[0], tcp_in_base)
    path = _solve_together(chain, start, goals)
    if path is None or _largest_jump(path) > MAX_JUMP:
        path = _solve_in_turn(chain, start, goals)
    if path is None:
        raise PlanningFailed(stage, "line_unreachable")
    if _largest_jump(path) > MAX_JUMP:
        raise PlanningFailed(stage, "line_joint_jump")
    return path


def _solve_together(chain: ArmChain, start: Array, goals: Array) -> Array | None:
    """Return a path (n + 1, 7) along poses (n, 4, 4): one step to every few poses, then steps of all poses together."""
    path = np.empty((len(goals) + 1, 7))
    path[0] = start
    for before in range(0, len(goals), STRIDE):
        after = min(before + STRIDE, len(goals))
        estimate = newton_step(chain, path[before, None], goals[after - 1, None])[0][0]
        path[before : after + 1] = np.linspace(path[before], estimate, after - before + 1)
    for _ in range(TOGETHER):
        following, error = newton_step(chain, path[1:], goals)
        if error.max() <= TOLERANCE:
            return path
        path[1:] = following
    return None


def _solve_in_turn(chain: ArmChain, start: Array, goals: Array) -> Array | None:
    path = [start]
    for goal in goals:
        qpos = path[-1][None]
        for _ in range(IN_TURN):
            following, error = newton_step(chain, qpos, goal[None])
            if error[0] <= TOLERANCE:
                break
            qpos = following
        else:
            return None
        path.append(qpos[0])
        if _largest_jump(np.array(path[-2:])) > MAX_JUMP:
            break
    return np.array(path)


def _largest_jump(path: Array) -> float:
    return float(np.abs(np.diff(path, axis=0)).max())


def _line_poses(first: Array, last: Array) -> Array:
    turn, shift = rotation_vector((first[:3, :3].T @ last[:3, :3])[None])[0], last[:3, 3] - first[:3, 3]
    count = max(1, int(np.ceil(max(np.linalg.norm(shift) / LINE_STEP, np.linalg.norm(turn) / LINE_TURN))))
    fractions = np.linspace(0, 1, count + 1)[1:, None]
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = (Rotation.from_matrix(first[:3, :3]) * Rotation.from_rotvec(fractions * turn)).as_matrix()
    poses[:, :3, 3] = first[:3, 3] + fractions * shift
    return poses
