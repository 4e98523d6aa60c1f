"""Batched iterative inverse kinematics of a serial arm.

The code runs on tensors without synchronizing with the device, and on NumPy arrays, which are faster on a CPU.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from robocas_ms3.core.arrays import Array, clamp, concatenate, known_all_false, matmul, where
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.rotations import left_product_matrix, standardize
from robocas_ms3.robots.description_file import read_joints

IK_ITERATIONS = 8
IK_DAMPING, IK_MIN_DAMPING = 0.1, 1e-6  # factor of the squared error, and constant term
IK_MAX_ERROR = 0.5  # limit of the error (m and rad combined) per iteration; larger linear steps diverge
IK_TOLERANCE = 1e-4  # error (m and rad combined) of a reached target
IK_CONVERGED = 1e-5  # error (m and rad combined) at which the iteration stops


class SerialChain:
    """Inverse kinematics of the revolute joints between two links of a URDF.

    Only controllers use this class. The planner uses `planning.kinematics.ArmChain`, and datasets use
    `description_file.tcp_and_arm_base_poses`. All arrays are float64: float32 and TF32 errors exceed the tolerance.

    Args:
        urdf: the file.
        root, tip: names of the links. All poses are poses of the tip in the frame of the root.
        device: device of the tensors; None: the class uses NumPy arrays.

    Attributes:
        joint_names: names of the n joints from root to tip.

    Raises:
        RobotDescriptionError: the URDF is missing or malformed, or no joints lead from the root to the tip.
        RobocasError: a joint between the links is neither fixed nor revolute.
    """

    def __init__(self, urdf: Path | str, root: str, tip: str, device: Any = None) -> None:
        names: list[str] = []
        fixed: list[NDArray[np.float64]] = []  # n + 1 transforms between joint frames whose z is the joint's axis
        pending = np.eye(4)
        for joint in read_joints(Path(urdf), root, tip):
            if joint.kind not in ("fixed", "revolute"):
                where = f"{urdf}, {joint.name}"
                what, expected = "unsupported type of joint", "fixed or revolute"
                raise RobocasError(what, where=where, expected=expected, found=joint.kind)
            pending = pending @ joint.origin
            if joint.kind == "revolute":
                to_axis = _rotation_with_z_axis(joint.axis)
                names.append(joint.name)
                fixed.append(pending @ to_axis)
                pending = to_axis.T
        self.joint_names = tuple(names)
        constants = (*_joint_constants([*fixed, pending]), _QUOTIENT, np.eye(6))
        if device is not None:
            constants = tuple(torch.tensor(value, dtype=torch.float64, device=device) for value in constants)
        self._angles, self._shift, self._weights, self._constant, self._quotient, self._identity = constants

    def solve_inverse(
        self, position: Array, quaternion: Array, qpos: Array, lower: Array, upper: Array
    ) -> tuple[Array, Array]:
        """Solve inverse kinematics within joint limits for N envs, starting from given joint positions.

        Levenberg-Marquardt with damping proportional to the squared error (Sugihara, IEEE T-RO 27(5), 2011). A joint at
        a limit does not take part in a step that would exceed the limit. Envs are independent of each other.

        Args:
            position: (N, 3) m, target positions of the tip in the root's frame.
            quaternion: (N, 4) wxyz unit quaternions of either sign. The norm is not checked; another norm gives wrong
                results, since it scales the rotation error.
            qpos: (N, n) rad, initial joint positions.
            lower, upper: (n,) rad, joint limits.

        Returns:
            Joint positions (N, n), rad, within the limits. For each env (N,) whether the error is below
            ``IK_TOLERANCE``.
        """
        to_target = (quaternion @ self._quotient).reshape(-1, 4, 4)
        position, qpos, lower, upper = position[..., None], qpos[..., None], lower[:, None], upper[:, None]
        iteration = 0
        while True:
            frames = self._frames(qpos[..., 0])
            tip = frames[-1]
            rotation = matmul(to_target, tip[1, ..., :1])
            rotation = standardize(rotation)
            error = concatenate([position - tip[0, :, :3, 3:], 2 * rotation[:, 1:]], axis=1)  # (N, 6, 1)
            square = matmul(error.swapaxes(1, 2), error)  # (N, 1, 1)
            moving = square > IK_CONVERGED**2
            if iteration == IK_ITERATIONS or known_all_false(moving):
                return qpos[..., 0], square[:, 0, 0] < IK_TOLERANCE**2
            error = error * moving / clamp(square**0.5 / IK_MAX_ERROR, 1.0, np.inf)
            twists = _transposed_jacobian(frames)
            room = where(matmul(twists, error) < 0, qpos - lower, upper - qpos)
            twists = twists * (room > 0)
            damping = (IK_DAMPING * square + IK_MIN_DAMPING) * self._identity
            step = matmul(twists, _solve(matmul(twists.swapaxes(1, 2), twists) + damping, error))
            qpos = clamp(qpos + step, lower, upper)
            iteration += 1

    def _frames(self, qpos: Array) -> Array:
        """Return two matrices for each joint and the tip, (n + 1, 2, N, 4, 4).

        The first is the pose, the second the left product matrix of the orientation's quaternion.
        """
        rows, count = len(qpos), qpos.shape[1] + 1
        angles = qpos @ self._angles + self._shift
        sines = torch.sin(angles) if isinstance(angles, Tensor) else np.sin(angles)
        local = sines @ self._weights + self._constant
        frames = local.reshape(rows, -1, 4, 4).swapaxes(0, 1).reshape(-1, 4, 4)
        # prefix product by doubling: each matrix covers the last 2, 4, 8, ... joints
        joined = 1
        while joined < count:
            skipped = 2 * rows * joined
            later = frames[skipped:]
            later[:] = matmul(frames[:-skipped], later)  # pyright: ignore[reportArgumentType]
            joined *= 2
        return frames.reshape(count, 2, rows, 4, 4)


def _joint_constants(fixed: list[NDArray[np.float64]]) -> tuple[NDArray[np.float64], ...]:
    """Return constants A, b, W, c; `SerialChain._frames` multiplies the matrices sin(q A + b) W + c.

    A has four columns per joint: the sines of q and q + 90 deg rotate poses about z, the sines of q / 2 and
    q / 2 + 90 deg rotate quaternions.
    """
    count = len(fixed) - 1
    angles = np.asarray(np.kron(np.eye(count), [1, 1, 0.5, 0.5]), dtype=np.float64)
    shift = np.tile([0, np.pi / 2], 2 * count)
    weights, constant = np.zeros((count, 4, count + 1, 2, 4, 4)), np.zeros((count + 1, 2, 4, 4))
    quarter_turn = np.zeros((4, 4))
    quarter_turn[:2, :2] = [[0, -1], [1, 0]]
    half_turn = left_product_matrix(np.array([[0.0, 0, 0, 1]]))[0]
    for i, pose in enumerate(fixed):
        quaternion = left_product_matrix(Rotation.from_matrix(pose[:3, :3]).as_quat()[None, [3, 0, 1, 2]])[0]
        if i == count:
            constant[i] = pose, quaternion
        else:
            constant[i, 0] = pose @ np.diag([0, 0, 1, 1])
            weights[i, :2, i, 0] = pose @ quarter_turn, pose @ np.diag([1, 1, 0, 0])
            weights[i, 2:, i, 1] = quaternion @ half_turn, quaternion
    return angles, shift, weights.reshape(4 * count, -1), constant.reshape(-1)


def _rotation_with_z_axis(z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a rotation as transform (4, 4) whose z axis is the unit vector ``z``."""
    x = np.cross([1, 0, 0] if abs(z[1]) > 0.9 else [0, 1, 0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    return pose


_QUOTIENT = (left_product_matrix(np.eye(4)) @ np.diag([1, -1, -1, -1])).reshape(4, 16)
"""Constant that converts quaternions a (N, 4) to matrices (N, 16) of the map b -> a * conjugate(b)."""


def _transposed_jacobian(frames: Array) -> Array:
    """Return the transposed Jacobian (N, n, 6) of the tip.

    Row i has translation (m) and rotation (rad) of the tip per rad of joint i.
    """
    poses = frames[:, 0, :, :3]
    axes, points = poses[:-1, ..., 2], poses[..., 3]
    return concatenate([_cross(axes, points[-1:] - points[:-1]), axes]).swapaxes(0, 1)


def _cross(first: Array, second: Array) -> Array:
    if isinstance(first, Tensor):
        return torch.linalg.cross(first, second)
    products = first[..., None] * second[..., None, :]  # `np.cross` is five times slower
    return (products - products.swapaxes(-1, -2)).reshape(*first.shape[:-1], 9)[..., [5, 6, 1]]


def _solve(matrices: Array, columns: Array) -> Array:
    if isinstance(matrices, Tensor):
        return torch.linalg.solve_ex(matrices, columns)[0]  # `solve` synchronizes to report singular matrices
    return np.linalg.solve(matrices, columns)
