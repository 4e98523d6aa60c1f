"""Dataset actions of demonstrations with action noise, worked out by hand."""

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.demos.recordings.motion import Motion
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.registry import PANDA

NOISE = np.array([0.02, -0.05, 0.03])  # rad, of the steps 0 to 2


def rotations_about_z(motion):
    """Return the rotations of the actions about the z axis of the TCP, which is the axis of joint 7."""
    actions = motion.actions
    np.testing.assert_allclose(actions[:, :5], 0, atol=1e-6)
    return actions[:-1, 5]


def make_motion(deviations):
    """Return the motion of an arm that is to turn joint 7 by 0.1 rad per dataset step of two control steps."""
    states = np.zeros((7, 37), np.float32)
    states[:, 3] = 1  # w of the root's quaternion
    states[:, 16:23] = MOBILE_PANDA.arm_rest
    half = np.array([0.01, -0.01, 0.02])  # deviations at the control steps that the dataset does not contain
    joint_deviations = np.zeros((6, 7))
    joint_deviations[:, 6] = np.stack([half, NOISE], axis=1).ravel()
    states[:, 22] += 0.05 * np.arange(7) + np.append(0, joint_deviations[:, 6])
    samples = np.array([0, 2, 4, 6])
    return Motion.from_states(PANDA, states, np.ones(6), samples, joint_deviations if deviations else None)


def test_noise_of_a_step_is_corrected_by_the_next_action_and_missing_in_its_own():
    # the arm is at 0, 0.1 + n0, 0.2 + n1, 0.3 + n2; the intended positions are 0, 0.1, 0.2, 0.3
    motion = make_motion(deviations=True)
    expected = [0.1, 0.1 - NOISE[0], 0.1 - NOISE[1]]
    np.testing.assert_allclose(rotations_about_z(motion), expected, atol=1e-6)
    assert motion.intended_joints is not None and motion.intended_tcp_in_base is not None
    np.testing.assert_allclose(motion.intended_joints[:, 6], MOBILE_PANDA.arm_rest[6] + 0.1 * np.arange(4), atol=1e-6)
    turned = np.swapaxes(motion.intended_tcp_in_base[:, :3, :3], 1, 2) @ motion.tcp_in_base[:, :3, :3]
    np.testing.assert_allclose(Rotation.from_matrix(turned).as_rotvec()[:, 2], [0, *NOISE], atol=1e-6)


def test_without_deviations_the_actions_are_the_executed_motion():
    motion = make_motion(deviations=False)
    np.testing.assert_allclose(
        rotations_about_z(motion), [0.1 + NOISE[0], 0.1 + NOISE[1] - NOISE[0], 0.1 + NOISE[2] - NOISE[1]], atol=1e-6
    )
    assert motion.intended_joints is None
