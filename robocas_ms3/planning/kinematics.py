"""Forward and inverse kinematics of an arm for batches of poses, and straight lines of its TCP.

The module does not use BLAS. Starting its threads takes longer than products of 3 x 3 matrices, and the last bits of
its results depend on the number of threads.
"""

from __future__ import annotations

from copy import copy
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.extensions import import_object
from robocas_ms3.planning.protocol import Array
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.description_file import RobotXml

LIMIT_MARGIN = 0.02  # rad to each joint limit
JOINT7_STEP = 0.25  # rad between sampled positions of joint 7, for batches of poses
JOINT7_FINE_STEP = 0.1  # rad, for a single pose
MIN_SOLUTION_DISTANCE = 0.3  # rad (norm over joints) between distinct solutions
MAX_SOLUTIONS = 40  # distinct solutions per pose
LINE_STEP = 0.01  # m between poses of a straight line
LINE_TURN = np.deg2rad(3)  # rad between poses of a straight line
MAX_JUMP = 0.15  # rad, maximum joint displacement between poses of a straight line
ESTIMATE_STRIDE = 4  # poses between initial estimates
LINE_ITERATIONS = 8  # Newton steps for all poses of a line at once
POSE_ITERATIONS = 60  # Newton steps for a single pose
TOLERANCE = 1e-7  # accepted pose error, norm over m and rad
HALF_TURN = -0.99  # cosine below which a rotation is treated as a half turn
DAMPING = 1e-8  # added to the diagonal of J J^T, so that it is invertible at singularities


class ArmChain:
    """Forward kinematics of an arm with seven revolute joints about the z axes of their links.

    The class computes the frames of all links in NumPy without BLAS, so that plans are reproducible to the bit.
    Controllers on a GPU use `robots.kinematics.SerialChain` instead.

    Attributes:
        robot: description of the robot.
        links: eight fixed transforms (4x4): the pose of each link in the previous link at 0 rad, and the pose of the
            TCP in link 7.
        hand_in_tcp: (4x4) pose of the hand link in the TCP frame.
        limits: (7, 2) lower and upper joint limits, rad.
        lower: (7,) lower joint limits plus ``LIMIT_MARGIN``, rad.
        upper: (7,) upper joint limits minus ``LIMIT_MARGIN``, rad.

    Raises:
        RobotDescriptionError: the URDF is missing or malformed, or describes another arm.
    """

    def __init__(self, arm_urdf: Path | str, robot: RobotDescription) -> None:
        self.robot = robot
        file = RobotXml(arm_urdf)
        chain = file.joints_between(robot.arm_base_link, robot.tcp_link)
        turning = [joint for joint in chain if joint.kind == "revolute"]
        names = tuple(joint.name for joint in turning)
        if names != robot.arm_joints or not all(joint.axis.tolist() == [0, 0, 1] for joint in turning):
            expected = f"{', '.join(robot.arm_joints)}, each about z"
            axes = (f"{joint.name} about {joint.axis.tolist()}" for joint in turning)
            raise file.make_error(f"wrong arm joints for {robot.uid}", expected, ", ".join(axes))
        self.links, self.hand_in_tcp = [], np.eye(4)
        pending, after_hand = np.eye(4), False
        for joint in chain:
            pending = pending @ joint.origin
            if after_hand:
                self.hand_in_tcp = self.hand_in_tcp @ joint.origin
            if joint in turning:
                self.links.append(pending)
                pending = np.eye(4)
            after_hand |= joint.child == robot.hand_link
        self.links.append(pending)
        self.hand_in_tcp = np.linalg.inv(self.hand_in_tcp)
        without = [joint.name for joint in turning if joint.limits is None]
        if without:
            expected = "a <limit> element in each arm joint"
            raise file.make_error("arm joints without limits", expected, ", ".join(without))
        self.limits = np.array([joint.limits for joint in turning])
        self.lower, self.upper = self.limits[:, 0] + LIMIT_MARGIN, self.limits[:, 1] - LIMIT_MARGIN

    def with_tool_offset(self, distance: float) -> ArmChain:
        """Return a copy of the chain with the TCP shifted by ``distance`` (m) against the approach axis."""
        chain, back = copy(self), np.eye(4)
        back[2, 3] = -distance
        chain.links = [*self.links[:-1], self.links[-1] @ back]
        return chain

    def link_frames(self, qpos: Array) -> tuple[Array, Array]:
        """Compute the poses of links 1 to 7 and of the TCP at configurations (M, 7).

        Returns:
            Rotation matrices (8, M, 3, 3) and positions (8, M, 3) m, in the arm's base frame.
        """
        count, qpos = len(qpos), np.ascontiguousarray(qpos)
        rotations, positions = np.empty((8, count, 3, 3)), np.empty((8, count, 3))
        fixed = np.array(self.links)[:, None, :3, :3]
        cosine, sine = np.cos(qpos).T[:, :, None], np.sin(qpos).T[:, :, None]
        # pose of each link in the previous one
        local = np.empty((8, count, 3, 3))
        local[:7, ..., 0] = fixed[:7, ..., 0] * cosine + fixed[:7, ..., 1] * sine
        local[:7, ..., 1] = fixed[:7, ..., 1] * cosine - fixed[:7, ..., 0] * sine
        local[:7, ..., 2], local[7] = fixed[:7, ..., 2], fixed[7]
        rotations[0], positions[0] = local[0], self.links[0][:3, 3]
        for i in range(1, 8):
            np.einsum("mij,mjk->mik", rotations[i - 1], local[i], out=rotations[i])
            np.einsum("mij,j->mi", rotations[i - 1], self.links[i][:3, 3], out=positions[i])
            positions[i] += positions[i - 1]
        return rotations, positions

    def tcp(self, qpos: Array) -> Array:
        """Compute the TCP poses (M, 4, 4) in the arm's base frame at configurations (M, 7)."""
        rotations, positions = self.link_frames(qpos)
        return _to_matrices(rotations[7], positions[7])

    def jacobian(self, qpos: Array) -> tuple[Array, Array]:
        """Compute the TCP poses (M, 4, 4) and Jacobians (M, 6, 7) at configurations (M, 7).

        Both are in the arm's base frame.

        The first three rows of a Jacobian are linear, the last three angular.
        """
        rotations, positions = self.link_frames(qpos)
        axes = rotations[:7, :, :, 2].transpose(1, 2, 0)
        arm = (positions[7] - positions[:7]).transpose(1, 2, 0)
        jacobian = np.empty((len(qpos), 6, 7))
        for row, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
            jacobian[:, row] = axes[:, j] * arm[:, k] - axes[:, k] * arm[:, j]
        jacobian[:, 3:] = axes
        return _to_matrices(rotations[7], positions[7]), jacobian


def joint_distance(qpos: Array, near: Array) -> Array:
    """Return the distance (...) of configurations (..., 7) to the configuration ``near`` (7,), rad.

    The distance is the largest joint displacement, which determines the duration of a motion, plus 0.2 of the norm.
    """
    away = np.abs(qpos - near)
    return away.max(axis=-1) + 0.2 * np.sqrt((away * away).sum(axis=-1))


def _to_matrices(rotation: Array, position: Array) -> Array:
    pose = np.tile(np.eye(4), (len(position), 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = rotation, position
    return pose


class InverseKinematics:
    """Inverse kinematics of an arm for batches of TCP poses in the arm's base frame.

    Collisions are not checked.

    The class samples positions of joint 7 and calls the closed-form solver that the robot description names.

    Args:
        chain: forward kinematics of the arm.
    """

    def __init__(self, chain: ArmChain) -> None:
        self.chain = chain
        self.lower, self.upper = self.chain.lower, self.chain.upper
        self._geometry = import_object(self.chain.robot.inverse_kinematics)(self.chain)

    def nearest_solutions(self, tcp_in_base: Array, near: Array) -> tuple[NDArray[np.bool_], Array]:
        """Find the solution nearest to the configuration ``near`` (7,) for each TCP pose (N, 4, 4).

        Returns:
            Mask (N,) of the poses that have a solution within the joint limits; solutions (N, 7), NaN where the mask is
            False.
        """
        poses, near = np.asarray(tcp_in_base, dtype=np.float64).reshape(-1, 4, 4), np.asarray(near, dtype=np.float64)
        if len(poses) == 0:
            return np.zeros(0, dtype=bool), np.zeros((0, 7))
        found = self._solve(poses, near, JOINT7_STEP)
        away = np.where(np.isnan(found[..., 0]), np.inf, joint_distance(found, near))
        best = away.argmin(axis=1)
        qpos = found[np.arange(len(poses)), best]
        return np.isfinite(qpos[:, 0]), qpos

    def all_solutions(self, tcp_in_base: Array, near: Array) -> tuple[Array, NDArray[np.intp]]:
        """Find all solutions for TCP poses (N, 4, 4), with positions of joint 7 sampled from ``near`` (7,).

        Returns:
            Configurations (M, 7) of all poses; index (M,) of the pose of each configuration.
        """
        found = self._solve(np.asarray(tcp_in_base, dtype=np.float64), np.asarray(near, dtype=np.float64), JOINT7_STEP)
        exists = np.isfinite(found[..., 0])
        return found[exists], np.nonzero(exists)[0]

    def distinct_solutions(self, tcp_in_base: Array, near: Array) -> list[Array]:
        """Find distinct solutions (7,) for one TCP pose (4x4), the solution nearest to ``near`` (7,) first."""
        found = self._solve(np.asarray(tcp_in_base, dtype=np.float64)[None], near, JOINT7_FINE_STEP)[0]
        found = found[np.isfinite(found[:, 0])]
        kept: list[Array] = []
        for qpos in found[np.argsort(joint_distance(found, near), kind="stable")]:
            if all(np.linalg.norm(qpos - other) >= MIN_SOLUTION_DISTANCE for other in kept):
                kept.append(qpos)
        return kept[:MAX_SOLUTIONS]

    def _solve(self, poses: Array, near: Array, step: float) -> Array:
        """Return the IK solutions (N, K, 7) of poses (N, 4, 4), with joint 7 sampled every ``step`` rad; NaN: none."""
        first, last = np.ceil((self.lower[6] - near[6]) / step), np.floor((self.upper[6] - near[6]) / step)
        turns = np.clip(near[6] + step * np.arange(first, last + 1), self.lower[6], self.upper[6])
        solved = self._geometry.solve(np.repeat(poses, len(turns), axis=0), np.tile(turns, len(poses)))
        return solved.reshape(len(poses), -1, 7)


def to_rotation_vectors(rotations: Array) -> Array:
    """Convert rotation matrices (M, 3, 3) to rotation vectors (M, 3), rad, of norm at most pi."""
    twice_sine_axis = rotations[:, (2, 0, 1), (1, 2, 0)] - rotations[:, (1, 2, 0), (2, 0, 1)]
    sine = np.sqrt(np.einsum("mi,mi->m", twice_sine_axis, twice_sine_axis)) / 2
    cosine = (np.einsum("mii->m", rotations) - 1) / 2
    angle = np.arctan2(sine, cosine)
    vectors = twice_sine_axis * (angle / (2 * np.maximum(sine, 1e-300)))[:, None]
    half_turns = cosine < HALF_TURN  # the axis is ill-conditioned there
    if half_turns.any():
        vectors[half_turns] = Rotation.from_matrix(rotations[half_turns]).as_rotvec()
    return vectors


def apply_newton_step(chain: ArmChain, qpos: Array, goals: Array) -> tuple[Array, Array]:
    """Move each configuration by one damped Newton step towards a TCP pose, within the joint limits.

    The step has minimum norm. It is computed without BLAS and LAPACK, since the last bits of their results depend on
    the processor and on the number of threads.

    Args:
        chain: forward kinematics of the arm.
        qpos: (M, 7) configurations, rad.
        goals: (M, 4, 4) TCP poses in the arm's base frame.

    Returns:
        Configurations (M, 7) after the step; pose errors (M,) before the step, norm over m and rad.
    """
    poses, jacobian = chain.jacobian(qpos)
    error = np.empty((len(qpos), 6))
    error[:, :3] = goals[:, :3, 3] - poses[:, :3, 3]
    error[:, 3:] = to_rotation_vectors(np.einsum("mij,mkj->mik", goals[:, :3, :3], poses[:, :3, :3]))
    square = np.einsum("mij,mkj->mik", jacobian, jacobian)
    square[:, range(6), range(6)] += DAMPING
    step = np.einsum("mji,mj->mi", jacobian, solve_positive_definite(square, error))
    return np.clip(qpos + step, chain.lower, chain.upper), np.sqrt(np.einsum("mi,mi->m", error, error))


def solve_positive_definite(matrices: Array, values: Array) -> Array:
    """Return the solutions (M, N) of positive definite systems (M, N, N) with right-hand sides (M, N)."""
    rows = np.concatenate([matrices, values[:, :, None]], axis=2)
    for pivot in range(rows.shape[1]):
        rows[:, pivot] /= rows[:, pivot, pivot, None]
        factors = rows[:, :, pivot].copy()
        factors[:, pivot] = 0.0
        rows -= factors[:, :, None] * rows[:, pivot, None, :]
    return rows[:, :, -1]


def solve_straight_line(
    chain: ArmChain, start: Array, tcp_in_base: Array, *, stage: str, sequential: bool = True
) -> Array:
    """Compute configurations with the TCP on a straight line from its pose at ``start`` to another pose.

    The position is interpolated linearly, the orientation along the shortest rotation.

    Args:
        chain: forward kinematics of the arm.
        start: (7,) first configuration.
        tcp_in_base: (4x4) last TCP pose in the arm's base frame.
        stage: stage of a ``PlanningError``.
        sequential: whether the poses are solved one after another if they cannot be solved simultaneously. This finds a
            few more lines; where there is none, it takes most of the time.

    Returns:
        (n, 7) configurations; the TCP poses of neighbours are at most 1 cm and 3 deg apart.

    Raises:
        PlanningError: reason ``line_unreachable`` (a pose is out of reach) or ``line_joint_jump`` (a joint would have
            to jump).
    """
    start = np.asarray(start, dtype=np.float64)
    goals = _interpolate_poses(chain.tcp(start[None])[0], tcp_in_base)
    path = _solve_simultaneously(chain, start, goals)
    if sequential and (path is None or _largest_jump(path) > MAX_JUMP):
        path = _solve_sequentially(chain, start, goals)
    if path is None:
        raise PlanningError(stage, "line_unreachable")
    if _largest_jump(path) > MAX_JUMP:
        raise PlanningError(stage, "line_joint_jump")
    return path


def _solve_simultaneously(chain: ArmChain, start: Array, goals: Array) -> Array | None:
    """Return a path (n + 1, 7) from ``start`` through all poses (n, 4, 4) of a line, or None.

    All poses are solved at once.

    Initial estimates come from one Newton step to every ``ESTIMATE_STRIDE``-th pose.
    """
    path = np.empty((len(goals) + 1, 7))
    path[0] = start
    for before in range(0, len(goals), ESTIMATE_STRIDE):
        after = min(before + ESTIMATE_STRIDE, len(goals))
        estimate = apply_newton_step(chain, path[before, None], goals[after - 1, None])[0][0]
        path[before : after + 1] = np.linspace(path[before], estimate, after - before + 1)
    for _ in range(LINE_ITERATIONS):
        following, error = apply_newton_step(chain, path[1:], goals)
        if error.max() <= TOLERANCE:
            return path
        path[1:] = following
    return None


def _solve_sequentially(chain: ArmChain, start: Array, goals: Array) -> Array | None:
    path = [start]
    for goal in goals:
        qpos = path[-1][None]
        for _ in range(POSE_ITERATIONS):
            following, error = apply_newton_step(chain, qpos, goal[None])
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


def _interpolate_poses(first: Array, last: Array) -> Array:
    turn, shift = to_rotation_vectors((first[:3, :3].T @ last[:3, :3])[None])[0], last[:3, 3] - first[:3, 3]
    count = max(1, int(np.ceil(max(np.linalg.norm(shift) / LINE_STEP, np.linalg.norm(turn) / LINE_TURN))))
    fractions = np.linspace(0, 1, count + 1)[1:, None]
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = (Rotation.from_matrix(first[:3, :3]) * Rotation.from_rotvec(fractions * turn)).as_matrix()
    poses[:, :3, 3] = first[:3, 3] + fractions * shift
    return poses
