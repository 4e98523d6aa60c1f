"""Compute arm configurations that move a grasped handle along the motion of its joint.

The handle is a bar along the TCP's x axis. The fingers may rotate about the bar, since a hinged door rotates more than
the wrist can follow and friction on a bar of 1 cm is small.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from robocas_ms3.planning.kinematics import ArmChain
from robocas_ms3.planning.protocol import Array

MAX_SLIP = np.deg2rad(50)  # maximum rotation of the gripper about the bar; beyond it the palm touches the front
MAX_JUMP = 0.2  # rad, maximum joint displacement between two poses of the handle
ITERATIONS = 14
NULLSPACE_ITERATIONS = 6  # iterations that use the null space to move away from joint limits
POSITION_TOLERANCE, ROTATION_TOLERANCE = 2e-4, 2e-3  # m, rad

# OpenBLAS starts threads even for 6 x 6 matrices: ten times slower, and the last bits depend on their number
_BLAS = ThreadpoolController()


def rotate_about_bar(tcp: Array, angle: float) -> Array:
    """Rotate TCP poses (..., 4, 4) about the bar, which is their x axis, by an angle in rad."""
    turn = np.eye(4)
    turn[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return tcp @ turn


@_BLAS.wrap(limits=1, user_api="blas")
def track_handle(chain: ArmChain, starts: Array, goals: Array) -> Array:
    """Compute N paths of the arm that move a bar through T poses.

    The gripper may rotate about the bar by up to ``MAX_SLIP`` from the goal poses.

    Args:
        chain: forward kinematics of the arm.
        starts: (N, 7) configurations at or near the first pose.
        goals: (T, 4, 4) or (T, N, 4, 4) TCP poses in the arm's base frame, about 1 cm apart, with the gripper
            perpendicular to the bar.

    Returns:
        (T, N, 7) rad. A path is NaN from the first pose on that is out of reach, violates a joint limit or needs a
        joint jump.
    """
    qpos = np.array(starts, dtype=np.float64)
    path = np.full((len(goals), len(qpos), 7), np.nan)
    alive = np.arange(len(qpos))
    for step, goal in enumerate(goals):
        wanted = np.broadcast_to(goal, (len(qpos), 4, 4))[alive]
        found, solved = _solve(chain, qpos[alive], wanted)
        if step:
            solved &= np.abs(found - qpos[alive]).max(axis=1) <= MAX_JUMP
        alive, found = alive[solved], found[solved]
        qpos[alive] = found
        path[step, alive] = found
    return path


def count_reached_poses(path: Array) -> NDArray[np.int_]:
    """Return the number of poses (N,) that each path of `track_handle` (T, N, 7) reaches."""
    return np.isfinite(path[:, :, 0]).sum(axis=0)


def _solve(chain: ArmChain, starts: Array, goals: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Solve TCP poses (M, 4, 4) by damped least squares.

    Returns configurations (M, 7) and a mask (M,) of the solved poses.
    """
    qpos, lower, upper = starts.copy(), chain.lower, chain.upper
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    solved = np.zeros(len(qpos), dtype=bool)
    bar = goals[:, :3, 0]
    for iteration in range(ITERATIONS):
        pose, jacobian = chain.jacobian(qpos)
        error = pose_difference(pose, goals)
        lag = (error[:, 3:] * bar).sum(axis=1)
        free = np.abs(lag) <= MAX_SLIP
        error[:, 3:] -= bar * np.clip(lag, -MAX_SLIP, MAX_SLIP)[:, None]
        along = (bar[:, :, None] * jacobian[:, 3:]).sum(axis=1)  # angular velocity about the bar
        jacobian[:, 3:] -= np.where(free, 1.0, 0.0)[:, None, None] * bar[:, :, None] * along[:, None]
        solved = (np.linalg.norm(error[:, :3], axis=1) <= POSITION_TOLERANCE) & (
            np.linalg.norm(error[:, 3:], axis=1) <= ROTATION_TOLERANCE
        )
        if solved.all() and iteration >= NULLSPACE_ITERATIONS:
            break
        square = jacobian @ jacobian.transpose(0, 2, 1) + 1e-6 * np.eye(6)
        step = (jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, error[:, :, None]))[:, :, 0]
        if iteration < NULLSPACE_ITERATIONS:
            away = -0.02 * ((qpos - middle) / half) ** 3
            moved = jacobian @ away[:, :, None]
            step += away - (jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, moved))[:, :, 0]
        step *= np.minimum(0.3 / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12), 1.0)
        qpos = np.clip(qpos + step, lower, upper)
    return qpos, solved


def pose_difference(pose: Array, goal: Array) -> Array:
    """Return the differences (M, 6) from poses to goals (M, 4, 4) in the arm's base frame.

    The first three columns are the translation in m, the last three the rotation vector in rad.
    """
    turn = np.einsum("mij,mkj->mik", goal[:, :3, :3], pose[:, :3, :3])
    axis = 0.5 * np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=1
    )
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(turn, axis1=1, axis2=2) - 1))
    scale = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)
    return np.concatenate([goal[:, :3, 3] - pose[:, :3, 3], axis * scale[:, None]], axis=1)
