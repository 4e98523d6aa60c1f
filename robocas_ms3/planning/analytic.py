"""Batched closed-form inverse kinematics of the Panda for given positions of joint 7.

An arm with another kinematic structure needs another class with the method ``solve``. Its robot description names the
class (`RobotDescription.inverse_kinematics`).

The geometry follows Y. He and S. Liu, "Analytical Inverse Kinematics for Franka Emika Panda" (2021). Joint 7 determines
the wrist. The elbow then has up to two positions on a circle, and each of them has two shoulder configurations.
"""

from __future__ import annotations

import numpy as np

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.planning.kinematics import ArmChain
from robocas_ms3.planning.protocol import Array

UPRIGHT = 1 - 1e-9  # cosine between upper arm and vertical; above it joints 1 and 3 are collinear (singular)


class PandaInverseKinematics:
    """Closed-form inverse kinematics of an arm with the joint axes of the Panda.

    Args:
        chain: chain of the arm, from which the link lengths are read.

    Raises:
        RobocasError: the chain has other joint axes than the Panda.
    """

    def __init__(self, chain: ArmChain) -> None:
        one, two, three, four, five, six, seven, tcp = chain.links
        self.d1, self.d3, self.d5 = one[2, 3], -three[1, 3], five[1, 3]
        self.a4, self.a7 = four[0, 3], seven[0, 3]
        half = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
        turns = (np.eye(3), half.T, half, half, half.T, half, half)
        rotations_fit = all(np.allclose(link[:3, :3], turn) for link, turn in zip(chain.links, turns, strict=False))
        places = ((0, 0, self.d1), (0, 0, 0), (0, -self.d3, 0), (self.a4, 0, 0), (-self.a4, self.d5, 0), (0, 0, 0))
        places_fit = all(
            np.allclose(link[:3, 3], place)
            for link, place in zip((one, two, three, four, five, six), places, strict=True)
        )
        if not (rotations_fit and places_fit and np.allclose(seven[:3, 3], (self.a7, 0, 0))):
            raise RobocasError(
                "closed-form inverse kinematics do not fit the arm",
                where=chain.robot.uid,
                expected="the joint axes of the Panda",
                fix="Set inverse_kinematics in the robot description to a class for this arm.",
            )
        self.link7_in_tcp = np.linalg.inv(tcp)
        self.lower, self.upper = chain.lower, chain.upper

    def solve(self, tcp_in_base: Array, joint7: Array) -> Array:
        """Return all configurations that reach TCP poses with given positions of joint 7.

        Args:
            tcp_in_base: (M, 4, 4) TCP poses in the arm's base frame.
            joint7: (M,) positions of joint 7, rad.

        Returns:
            (M, 4, 7) rad: four configurations per pose, two positions of the elbow with two configurations of the
            shoulder each. NaN marks a configuration that does not exist or violates a joint limit.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            return self._solve(
                np.asarray(tcp_in_base, dtype=np.float64), np.ascontiguousarray(joint7, dtype=np.float64)
            )

    def _solve(self, tcp_in_base: Array, joint7: Array) -> Array:
        flange = np.einsum("mij,jk->mik", tcp_in_base, self.link7_in_tcp)
        z7, cosine, sine = flange[:, :3, 2], np.cos(joint7)[:, None], np.sin(joint7)[:, None]
        # link 6 as columns x6, y6, z6: joint 7 turned back about z7
        x6 = flange[:, :3, 0] * cosine - flange[:, :3, 1] * sine
        z6 = _cross(z7, x6)
        y6 = -z7
        shoulder = np.array([0, 0, self.d1])
        to_wrist = flange[:, :3, 3] - self.a7 * x6 - shoulder
        distance = _norm(to_wrist)
        upper, lower = np.hypot(self.a4, self.d3), np.hypot(self.a4, self.d5)
        # the triangle of shoulder, elbow, wrist
        elbow = np.arccos((upper**2 + lower**2 - distance**2) / (2 * upper * lower))
        wrist = np.arccos((distance**2 + lower**2 - upper**2) / (2 * distance * lower))
        h46, h34 = np.arctan2(self.d5, self.a4), np.arctan2(self.d3, self.a4)
        q4 = elbow + h46 + h34 - 2 * np.pi
        at_wrist = np.arctan2(self.a4, self.d5) + wrist  # between the forearm's axis and the way to the shoulder
        along = -distance * np.cos(at_wrist)
        u, v = -_dot(x6, to_wrist), -_dot(y6, to_wrist)
        tilt, turned = np.arcsin(along / np.hypot(u, v)), np.arctan2(v, u)
        # where the forearm's axis meets that of the upper arm
        at_shoulder = 1.5 * np.pi - wrist - elbow - h34
        at_meeting = np.pi - at_shoulder - at_wrist
        reach = distance * np.sin(at_shoulder) / np.sin(at_meeting)
        found = np.empty((len(joint7), 4, 7))
        found[:, :, 6], found[:, :, 3] = joint7[:, None], q4[:, None]
        for branch, wrapped in enumerate((np.pi - tilt - turned, tilt - turned)):
            q6 = np.mod(wrapped - self.lower[5], 2 * np.pi) + self.lower[5]
            s6, c6 = np.sin(q6)[:, None], np.cos(q6)[:, None]
            forearm = x6 * s6 + y6 * c6
            to_meeting = to_wrist - reach[:, None] * forearm
            z3 = to_meeting / _norm(to_meeting)[:, None]
            level = np.abs(z3[:, 2]) < UPRIGHT
            y3 = -_cross(to_wrist, to_meeting)
            y3 /= _norm(y3)[:, None]
            x3 = _cross(y3, z3)
            # copies, since the last bit of arctan2 of strided arrays depends on their memory alignment
            x, y = z3[:, 0].copy(), z3[:, 1].copy()
            lean = np.arccos(np.clip(z3[:, 2], -1, 1))
            elbow_at = self.d3 * z3 + self.a4 * x3 - to_wrist + self.d5 * forearm
            x5, y5 = x6 * c6 - y6 * s6, -z6
            q5 = -np.arctan2(_dot(y5, elbow_at), _dot(x5, elbow_at))
            for side, (q1, q2) in enumerate(((np.arctan2(y, x), lean), (np.arctan2(-y, -x), -lean))):
                c1, s1, c2, s2 = np.cos(q1), np.sin(q1), np.cos(q2), np.sin(q2)
                # x3 in the frame of link 2
                across = x3[:, 0] * c1 * c2 + x3[:, 1] * s1 * c2 - x3[:, 2] * s2
                up = -x3[:, 0] * s1 + x3[:, 1] * c1
                row = found[:, 2 * branch + side]
                row[:, 0], row[:, 1], row[:, 2] = q1, np.where(level, q2, np.nan), np.arctan2(up, across)
                row[:, 4], row[:, 5] = q5, q6
        inside = np.all((found >= self.lower) & (found <= self.upper), axis=2)
        found[~inside] = np.nan
        return found


def _cross(a: Array, b: Array) -> Array:
    result = np.empty_like(a)
    result[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    result[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    result[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return result


def _dot(a: Array, b: Array) -> Array:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _norm(a: Array) -> Array:
    return np.sqrt(_dot(a, a))
