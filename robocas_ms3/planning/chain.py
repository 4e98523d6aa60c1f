"""The arm as a chain of links: forward kinematics and Jacobians of many configurations at once, in numpy.

Batches are computed without BLAS: its threads take longer to start than products of 3 x 3 matrices take, and the last
bits of its results depend on the number of threads.
"""

from __future__ import annotations

from copy import copy
from pathlib import Path

import numpy as np

from robocas_ms3.planning.protocol import Array
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.description_file import DescriptionFile

LIMIT_MARGIN = 0.02  # rad kept from every joint limit


class ArmChain:
    """Seven joints that turn about z of their own links, and the TCP fixed to the last.

    `robots.kinematics.SerialChain` serves controllers on a GPU; this class gives the frames of all links, in NumPy
    without BLAS, so that plans repeat exactly.

    Attributes:
        links: eight fixed transforms 4x4: from each link to the next one at 0 rad, the last to the TCP.
        hand_in_tcp: 4x4.
        limits: (7, 2) lower and upper joint limits, rad; ``lower`` and ``upper`` (7,) are these with a margin.

    Raises:
        RobotDescriptionError: the URDF of the arm is missing or malformed, or it does not describe that arm.
    """

    def __init__(self, arm_urdf: Path | str, robot: RobotDescription) -> None:
        self.robot = robot
        file = DescriptionFile(arm_urdf)
        chain = file.joints_between(robot.arm_base_link, robot.tcp_link)
        turning = [joint for joint in chain if joint.kind == "revolute"]
        names = tuple(joint.name for joint in turning)
        if names != robot.arm_joints or not all(joint.axis.tolist() == [0, 0, 1] for joint in turning):
            expected = f"{', '.join(robot.arm_joints)}, each about z"
            raise file.error(f"not the arm of {robot.uid}", expected, ", ".join(names))
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
            raise file.error("joints without limits", "a <limit> in each joint of the arm", ", ".join(without))
        self.limits = np.array([joint.limits for joint in turning])
        self.lower, self.upper = self.limits[:, 0] + LIMIT_MARGIN, self.limits[:, 1] - LIMIT_MARGIN

    def ending_behind(self, distance: float) -> ArmChain:
        """Return the same arm with its end a distance (m) behind the TCP, against the approach."""
        chain, back = copy(self), np.eye(4)
        back[2, 3] = -distance
        chain.links = [*self.links[:-1], self.links[-1] @ back]
        return chain

    def frames(self, qpos: Array) -> tuple[Array, Array]:
        """Give rotations (8, M, 3, 3) and positions (8, M, 3) of links 1 to 7 and the TCP in the base at (M, 7)."""
        count, qpos = len(qpos), np.ascontiguousarray(qpos)
        rotations, positions = np.empty((8, count, 3, 3)), np.empty((8, count, 3))
        fixed = np.array(self.links)[:, None, :3, :3]
        cosine, sine = np.cos(qpos).T[:, :, None], np.sin(qpos).T[:, :, None]
        # each link in the one before
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
        """Give TCP poses (M, 4, 4) in the base frame at (M, 7)."""
        rotations, positions = self.frames(qpos)
        return _poses(rotations[7], positions[7])

    def jacobian(self, qpos: Array) -> tuple[Array, Array]:
        """Give TCP poses (M, 4, 4) and Jacobians (M, 6, 7), linear rows first, in the base frame, at (M, 7)."""
        rotations, positions = self.frames(qpos)
        axes = rotations[:7, :, :, 2].transpose(1, 2, 0)
        arm = (positions[7] - positions[:7]).transpose(1, 2, 0)
        jacobian = np.empty((len(qpos), 6, 7))
        for row, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
            jacobian[:, row] = axes[:, j] * arm[:, k] - axes[:, k] * arm[:, j]
        jacobian[:, 3:] = axes
        return _poses(rotations[7], positions[7]), jacobian


def turn_between(qpos: Array, near: Array) -> Array:
    """Return how far apart configurations (..., 7) are: the largest turn, which sets the time, and some of all."""
    away = np.abs(qpos - near)
    return away.max(axis=-1) + 0.2 * np.sqrt((away * away).sum(axis=-1))


def _poses(rotation: Array, position: Array) -> Array:
    pose = np.tile(np.eye(4), (len(position), 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = rotation, position
    return pose
