"""Continuation along a straight line of the TCP."""

from __future__ import annotations

import numpy as np

from robocas_ms3.errors import PlanningFailed
from robocas_ms3.planning.collision import ArmWorld
from robocas_ms3.planning.protocol import Array
from robocas_ms3.planning.shapes import matrix_to_pose

LINE_STEP = 0.01  # m between two poses of a straight line
LINE_TURN = np.deg2rad(3)
MAX_JUMP = 0.15  # rad a joint may turn between two poses of a straight line


def rotation_vector(rotation: Array) -> Array:
    """Give the axis times the angle (3,) rad of a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_rotvec()


def pose_error(found: Array, wanted: Array) -> tuple[float, float]:
    """Give the distance (m) and angle (rad) between two poses (4x4)."""
    cosine = (np.trace(found[:3, :3].T @ wanted[:3, :3]) - 1) / 2
    sine = np.linalg.norm(found[:3, :3] - wanted[:3, :3]) / (2 * np.sqrt(2))  # sin(angle / 2), exact for small angles
    angle = 2 * np.arcsin(min(1.0, float(sine))) if cosine > 0 else float(np.arccos(np.clip(cosine, -1, 1)))
    return float(np.linalg.norm(found[:3, 3] - wanted[:3, 3])), angle


class ArmKinematics:
    """Pinocchio's closed-loop inverse kinematics with joint limits, made repeatable.

    Args:
        world: the arm; collisions are checked in it.
    """

    def __init__(self, world: ArmWorld) -> None:
        self._world = world
        self.lower, self.upper = world.chain.lower, world.chain.upper
        # The solver clamps every joint of the description, the fingers too.
        full_limits = np.concatenate(world.kinematics.get_joint_limits())
        self._full_lower, self._full_upper = full_limits[:, 0].copy(), full_limits[:, 1].copy()
        arm = world.arm_indices
        self._full_lower[arm], self._full_upper[arm] = self.lower, self.upper

    def _solve(self, pose: Array, start: Array, *, gain: float, iterations: int, tolerance: float) -> Array | None:
        """Solve from one start (7,) for a pose (7,); none when it does not converge inside the limits."""
        world = self._world
        full, converged, _ = world.kinematics.compute_IK_CLIK_JL(
            world.tcp_index,
            pose,
            world.full_qpos(start),
            self._full_lower,
            self._full_upper,
            tolerance,
            iterations,
            gain,
            1e-8,
        )
        qpos = world.arm_qpos(full)
        return qpos if converged and np.all((qpos >= self.lower) & (qpos <= self.upper)) else None

    def line(self, start: Array, tcp_in_base: Array, *, stage: str) -> Array:
        """Follow a straight line of the TCP (position linear, shortest rotation) from a configuration to a pose.

        Args:
            start: (7,).
            tcp_in_base: 4x4 goal.
            stage: name for errors.

        Returns:
            (n, 7) configurations at most 1 cm and 3 deg apart, the first is ``start``.

        Raises:
            PlanningFailed: ``line_unreachable`` (no configuration, or a joint limit), ``line_joint_jump``.
        """
        from scipy.spatial.transform import Rotation

        begin = self._world.tcp(start)
        turn = rotation_vector(begin[:3, :3].T @ tcp_in_base[:3, :3])
        shift = tcp_in_base[:3, 3] - begin[:3, 3]
        count = max(1, int(np.ceil(max(np.linalg.norm(shift) / LINE_STEP, np.linalg.norm(turn) / LINE_TURN))))
        rotations = Rotation.from_matrix(begin[:3, :3]) * Rotation.from_rotvec(
            np.linspace(0, 1, count + 1)[:, None] * turn
        )
        pose = np.tile(np.eye(4), (count + 1, 1, 1))
        pose[:, :3, :3] = rotations.as_matrix()
        pose[:, :3, 3] = begin[:3, 3] + np.linspace(0, 1, count + 1)[:, None] * shift
        path = [np.asarray(start, dtype=np.float64)]
        for target in pose[1:]:
            qpos = self._solve(matrix_to_pose(target), path[-1], gain=0.9, iterations=60, tolerance=1e-7)
            if qpos is None:
                raise PlanningFailed(stage, "line_unreachable")
            if np.abs(qpos - path[-1]).max() > MAX_JUMP:
                raise PlanningFailed(stage, "line_joint_jump")
            path.append(qpos)
        return np.array(path)
