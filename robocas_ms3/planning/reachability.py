"""Which of many poses the arm can reach at all: one batched inverse kinematics, before any planning."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from robocas_ms3.errors import RobocasError
from robocas_ms3.planning.collision import ARM_JOINTS, BASE_LINK, TCP_LINK
from robocas_ms3.planning.kinematics import LIMIT_MARGIN
from robocas_ms3.planning.protocol import Array

POSITION_TOLERANCE = 1e-4  # m
ROTATION_TOLERANCE = 1e-3  # rad
ITERATIONS = 30
LARGEST_STEP = 0.5  # rad a joint may turn in one iteration

# Restarts in groups; a later group tries only what is left. Arm forward, left, right; elbow out to either side, wrist
# turned; stretched, folded, far left and right.
RESTARTS = (
    (
        (0.0, -0.3, 0.0, -2.0, 0.0, 1.9, 0.78),
        (0.9, 0.3, 0.0, -1.8, 0.0, 2.1, 0.78),
        (-0.9, 0.3, 0.0, -1.8, 0.0, 2.1, 0.78),
    ),
    (
        (0.6, -0.2, -1.0, -2.2, 0.3, 2.0, -0.8),
        (-0.6, -0.2, 1.0, -2.2, -0.3, 2.0, 2.2),
        (0.0, 0.7, 0.0, -1.0, 0.0, 1.7, -2.0),
    ),
    ((1.8, 0.4, 0.0, -1.9, 0.0, 2.3, -0.8), (-1.8, 0.4, 0.0, -1.9, 0.0, 2.3, 2.3)),
    ((0.0, 0.5, 0.0, -1.8, 1.6, 1.9, 0.0), (0.0, 0.5, 0.0, -1.8, -1.6, 1.9, 1.5)),
)
SCATTERED_RESTARTS = 12  # the last group, all over the joint space, always the same


class Reachability:
    """Batched damped least squares; starts are fixed, so that answers repeat.

    pytorch-kinematics reads the chain. The Jacobian is evaluated in numpy: for hundreds of configurations that is
    several times faster on a shared CPU, and the last bits do not hang on the number of threads.

    Args:
        arm_urdf: the arm alone, rooted at ``panda_link0``, with the TCP as ``panda_hand_tcp``.

    Raises:
        RobocasError: the file is missing or is not the Panda's.
    """

    def __init__(self, arm_urdf: Path | str) -> None:
        import pytorch_kinematics as pk
        import torch

        if not Path(arm_urdf).is_file():
            raise RobocasError("no such robot description", where=arm_urdf)
        tree = ElementTree.parse(arm_urdf).getroot()
        for joint in tree.iterfind("joint"):
            for element in joint.findall("dynamics"):  # pytorch-kinematics complains about its attributes on stderr
                joint.remove(element)
        chain = pk.build_serial_chain_from_urdf(ElementTree.tostring(tree), TCP_LINK, BASE_LINK)
        chain = chain.to(dtype=torch.float64)
        names = tuple(chain.get_joint_parameter_names())
        if names != ARM_JOINTS:
            raise RobocasError("not a Panda", where=arm_urdf, expected=", ".join(ARM_JOINTS), found=", ".join(names))
        frames = chain.forward_kinematics(torch.zeros(1, 7, dtype=torch.float64), end_only=False)
        links = [BASE_LINK, *(name.replace("joint", "link") for name in ARM_JOINTS), TCP_LINK]
        at_zero = [frames[link].get_matrix()[0].numpy() for link in links]
        # Each joint turns about z of its own link, which these fixed transforms lead to.
        self._links = [np.linalg.inv(a) @ b for a, b in zip(at_zero[:-1], at_zero[1:], strict=True)]
        lower, upper = (np.asarray(limit, dtype=np.float64) for limit in chain.get_joint_limits())
        self.lower, self.upper = lower + LIMIT_MARGIN, upper - LIMIT_MARGIN
        # OpenBLAS starts threads even for 6 x 6 matrices: ten times slower, and the last bits hang on their number.
        self._blas = ThreadpoolController()
        self._scattered = np.random.default_rng(0).uniform(self.lower, self.upper, (SCATTERED_RESTARTS, 7))

    def reachable(self, tcp_in_base: Array, near: Array) -> tuple[NDArray[np.bool_], Array]:
        """Solve inverse kinematics for many poses at once; collisions do not count.

        Args:
            tcp_in_base: (N, 4, 4).
            near: (7,) preferred configuration: tried first; of several solutions the nearest is kept.

        Returns:
            (N,) whether a configuration inside the joint limits was found, and (N, 7) that one, NaN where none.
        """
        with self.one_thread():
            return self._reachable(np.asarray(tcp_in_base, dtype=np.float64).reshape(-1, 4, 4), np.asarray(near, float))

    def one_thread(self) -> AbstractContextManager:
        """Context in which linear algebra runs in one thread."""
        return self._blas.limit(limits=1, user_api="blas")

    def _reachable(self, goals: Array, near: Array) -> tuple[NDArray[np.bool_], Array]:
        qpos = np.full((len(goals), 7), np.nan)
        for starts in (near[None], *map(np.array, RESTARTS), self._scattered):
            left = np.flatnonzero(np.isnan(qpos[:, 0]))
            if len(left) == 0:
                break
            solved, found = self._descend(np.repeat(goals[left], len(starts), 0), np.tile(starts, (len(left), 1)))
            distance = np.where(solved, np.linalg.norm(found - near, axis=1), np.inf).reshape(len(left), -1)
            best = distance.argmin(axis=1)
            hit = np.isfinite(distance.min(axis=1))
            qpos[left[hit]] = found.reshape(len(left), -1, 7)[hit, best[hit]]
        return ~np.isnan(qpos[:, 0]), qpos

    def jacobian(self, qpos: Array) -> tuple[Array, Array]:
        """Give TCP poses (M, 4, 4) and Jacobians (M, 6, 7), linear rows first, in the base frame, at (M, 7)."""
        rotation, position = np.broadcast_to(np.eye(3), (len(qpos), 3, 3)), np.zeros((len(qpos), 3))
        cosine, sine = np.cos(qpos)[:, :, None], np.sin(qpos)[:, :, None]
        axes, origins = np.empty((len(qpos), 3, 7)), np.empty((len(qpos), 3, 7))
        for i, link in enumerate(self._links):
            position = position + rotation @ link[:3, 3]
            rotation = rotation @ link[:3, :3]
            if i == 7:
                break
            x, y = rotation[:, :, 0].copy(), rotation[:, :, 1].copy()
            rotation[:, :, 0] = x * cosine[:, i] + y * sine[:, i]
            rotation[:, :, 1] = y * cosine[:, i] - x * sine[:, i]
            axes[:, :, i], origins[:, :, i] = rotation[:, :, 2], position
        arm = position[:, :, None] - origins
        jacobian = np.empty((len(qpos), 6, 7))
        for row, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
            jacobian[:, row] = axes[:, j] * arm[:, k] - axes[:, k] * arm[:, j]
        jacobian[:, 3:] = axes
        pose = np.tile(np.eye(4), (len(qpos), 1, 1))
        pose[:, :3, :3], pose[:, :3, 3] = rotation, position
        return pose, jacobian

    def _descend(self, goals: Array, starts: Array) -> tuple[NDArray[np.bool_], Array]:
        """Iterate from starts (M, 7) to goals (M, 4, 4); give (M,) solved and (M, 7). Solved rows leave the batch."""
        qpos = np.clip(starts, self.lower, self.upper)
        solved = np.zeros(len(goals), dtype=bool)
        rows = np.arange(len(goals))
        for _ in range(ITERATIONS):
            pose, jacobian = self.jacobian(qpos[rows])
            error = twist(pose, goals[rows])
            close = (np.linalg.norm(error[:, :3], axis=1) <= POSITION_TOLERANCE) & (
                np.linalg.norm(error[:, 3:], axis=1) <= ROTATION_TOLERANCE
            )
            solved[rows[close]] = True
            rows, jacobian, error = rows[~close], jacobian[~close], error[~close]
            if len(rows) == 0:
                break
            damping = 1e-3 * np.minimum((error * error).sum(axis=1), 1.0) + 1e-7
            square = jacobian @ jacobian.transpose(0, 2, 1) + damping[:, None, None] * np.eye(6)
            step = (jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, error[:, :, None]))[:, :, 0]
            step *= np.minimum(LARGEST_STEP / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12), 1.0)
            qpos[rows] = np.clip(qpos[rows] + step, self.lower, self.upper)
        return solved, qpos


def twist(pose: Array, goal: Array) -> Array:
    """Position differences and rotation vectors (M, 6), in the base frame, that take ``pose`` to ``goal`` (M, 4, 4)."""
    turn = goal[:, :3, :3] @ pose[:, :3, :3].transpose(0, 2, 1)
    axis = 0.5 * np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=1
    )
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(turn, axis1=1, axis2=2) - 1))
    scale = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)
    return np.concatenate([goal[:, :3, 3] - pose[:, :3, 3], axis * scale[:, None]], axis=1)
