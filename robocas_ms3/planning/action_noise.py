"""Actuation noise: random errors of the pose that the arm reaches, one per dataset step.

Demonstrations with noise contain corrective actions, because the next planned target is absolute. This is the method
DART (Laskey et al. 2017): the noise disturbs the executed actions, and the labels are the intended actions.
"""

from __future__ import annotations

import math

import numpy as np

from robocas_ms3.planning.kinematics import ArmChain, solve_positive_definite
from robocas_ms3.planning.protocol import Array

NOISE_RATE = 5  # Hz, the rate of a dataset; at control rates that 5 does not divide, the noise has the control rate
_STREAM = 412  # random stream of the noise
_DAMPING = 1e-3  # added to the diagonal of J J^T: at singularities the noise is smaller than requested


def draw_noise(rng: np.random.Generator, count: int, std_mm: float, std_deg: float) -> Array:
    """Draw normal actuation noise (count, 7) for dataset actions.

    Args:
        rng: random generator.
        count: number of actions.
        std_mm: standard deviation of each translation component, mm.
        std_deg: standard deviation of each rotation component, deg.

    Returns:
        Translation in m, rotation in rad, and 0 for the gripper.
    """
    drawn = np.zeros((count, 7))
    drawn[:, :6] = rng.normal(size=(count, 6)) * np.repeat([std_mm / 1000, np.deg2rad(std_deg)], 3)
    return drawn


class ActionNoise:
    """Noise that is added to the joint targets of an episode.

    Each step of ``NOISE_RATE`` has one pose error, a normal translation and rotation in the TCP frame. The Jacobian
    maps it to a deviation of the arm joints, which the arm reaches at the end of the step. The errors depend on the
    seed and the number of the step only, so undone attempts and forked processes have the same errors.

    The drives of the joints are modelled as first-order systems, which follow their targets with a lag. The targets
    change linearly and lead by this lag.

    Args:
        chain: kinematics of the arm.
        std: standard deviation of each translation component in mm and of each rotation component in deg.
        control_freq: control rate, Hz.
        lag: lag of the drives of the arm joints, s.
    """

    def __init__(self, chain: ArmChain, std: tuple[float, float], control_freq: int, lag: float) -> None:
        self._chain, self._std = chain, std
        self._control_steps = control_freq // NOISE_RATE if control_freq % NOISE_RATE == 0 else 1
        self._lag_steps = lag * control_freq
        self.reset()

    def reset(self) -> None:
        """Start an episode without deviation."""
        self._previous = self._next = np.zeros(7)  # deviations at the start and the end of the present step
        self._offset = self._deviation = np.zeros(7)  # of the last target and of the arm

    def disturb(self, seed: int, index: int, qpos: Array) -> tuple[Array, Array]:
        """Disturb the joint targets of the next control step.

        Args:
            seed: seed of the episode.
            index: number of the control step since the reset; consecutive calls have consecutive numbers.
            qpos: (7,) intended joint targets, rad.

        Returns:
            Disturbed joint targets (7,); deviation (7,) of the arm joints at the end of the control step, rad.
        """
        step, phase = divmod(index, self._control_steps)
        if phase == 0:
            rng = np.random.default_rng([seed, _STREAM, step])
            error = draw_noise(rng, 1, *self._std)[0, :6]
            self._previous, self._next = self._next, self._to_joints(error, qpos)
        change = (self._next - self._previous) / self._control_steps  # per control step
        offset = self._previous + (phase + 1 + self._lag_steps) * change
        # response of a first-order system to a target that changes linearly from the last offset to the new one
        lead, decay = self._lag_steps * (offset - self._offset), math.exp(-1 / self._lag_steps)
        self._deviation = offset - lead + (self._deviation - self._offset + lead) * decay
        self._offset = offset
        return qpos + offset, self._deviation

    def _to_joints(self, error_in_tcp: Array, qpos: Array) -> Array:
        """Return the deviation (7,) of the joints, of minimum norm, that gives a pose error (6,) in the TCP frame."""
        pose, jacobian = (found[0] for found in self._chain.jacobian(np.asarray(qpos, np.float64)[None]))
        error = np.einsum("ij,kj->ki", pose[:3, :3], error_in_tcp.reshape(2, 3)).ravel()
        square = np.einsum("ij,kj->ik", jacobian, jacobian) + _DAMPING * np.eye(6)
        return np.einsum("ji,j->i", jacobian, solve_positive_definite(square[None], error[None])[0])
