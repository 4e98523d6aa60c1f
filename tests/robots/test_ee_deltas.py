"""Deltas of the end effector: the maths, and what they do in an empty environment, the robot turned by 90 deg."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from robot_checks import matrix, moved
from scipy.spatial.transform import Rotation

from robocas_ms3.robots.ee_deltas import apply_ee_delta, to_ee_delta_action

# Maths, without a simulation.


def test_delta_is_applied_in_the_end_effectors_frame():
    half = np.sqrt(0.5)
    position = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    quaternion = torch.tensor([[half, 0.0, 0.0, half], [0.0, 1.0, 0.0, 0.0]])  # yaw 90 deg; upside down about x
    delta = torch.tensor([[0.1, 0.0, 0.0, 0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.2, np.pi / 2, 0.0, 0.0]]).float()
    p, q = apply_ee_delta(position, quaternion, delta)
    assert p.numpy() == pytest.approx(np.array([[1.0, 2.1, 3.0], [0.0, 0.0, -0.2]]), abs=1e-6)
    assert q[0].abs().numpy() == pytest.approx([0, 0, 0, 1], abs=1e-6)  # 90 + 90 deg about z
    assert q[1].abs().numpy() == pytest.approx([half, half, 0, 0], abs=1e-6)  # 180 + 90 deg about x
    assert q[1, 0] * q[1, 1] < 0  # 270 deg, not 90


def test_the_action_of_a_motion_reproduces_the_motion():
    rng = np.random.default_rng(0)
    translation, rotvec = rng.uniform(-0.1, 0.1, (20, 3)), rng.uniform(-0.25, 0.25, (20, 3))
    action = to_ee_delta_action(translation, rotvec)
    assert action.shape == (20, 6)
    assert action[:, :3] == pytest.approx(translation / 0.1, rel=1e-5)
    start = Rotation.random(20, random_state=1)
    quaternion = torch.tensor(start.as_quat()[:, [3, 0, 1, 2]]).float()
    scaled = torch.tensor(action) * torch.tensor([0.1] * 3 + [0.5] * 3)
    p, q = apply_ee_delta(torch.zeros(20, 3), quaternion, scaled)
    reached = Rotation.from_quat(q.numpy()[:, [1, 2, 3, 0]])
    assert (start.inv() * reached).as_rotvec() == pytest.approx(rotvec, abs=1e-5)
    assert p.numpy() == pytest.approx(start.apply(translation), abs=1e-6)


def test_euler_conventions_give_different_actions():
    angles = np.array([0.3, 0.2, 0.1])
    assert to_ee_delta_action(np.zeros(3), angles, euler="XYZ")[3:] == pytest.approx(angles / 0.5)
    extrinsic = Rotation.from_euler("xyz", angles)
    assert to_ee_delta_action(np.zeros(3), angles, euler="xyz") == pytest.approx(
        to_ee_delta_action(np.zeros(3), extrinsic)
    )
    assert np.abs(to_ee_delta_action(np.zeros(3), extrinsic)[3:] - angles / 0.5).max() > 0.02


# In an environment.


@pytest.mark.parametrize("axis", range(6))
def test_ee_delta_moves_along_and_rotates_about_the_tcp_axes(make_env, axis):
    env, agent = make_env("pd_ee_delta_pose", control_freq=5)
    start = matrix(agent.tcp.pose)
    action = np.zeros(7, np.float32)
    action[axis] = 0.4
    env.step(action)
    translation, rotation = moved(start, matrix(agent.tcp.pose))
    motion = np.concatenate([translation / 0.1, rotation / 0.5])
    assert motion[axis] == pytest.approx(0.4, rel=0.12)
    assert np.abs(np.delete(motion, axis)).max() < 0.06


def test_ee_deltas_add_up_without_tracking_errors(make_env):
    env, agent = make_env("pd_ee_delta_pose", control_freq=5)
    start = matrix(agent.tcp.pose)
    for _ in range(10):
        env.step(np.array([0, 0, -0.15, 0, 0, 0.1, 1], np.float32))
    for _ in range(5):
        env.step(np.array([0, 0, 0, 0, 0, 0, 1], np.float32))
    translation, rotation = moved(start, matrix(agent.tcp.pose))
    assert translation == pytest.approx([0, 0, -0.15], abs=1e-3)
    assert rotation == pytest.approx([0, 0, 0.5], abs=2e-3)


def test_ee_deltas_start_at_the_current_pose_after_the_arm_was_blocked(make_env):
    env, agent = make_env("pd_ee_delta_pose", control_freq=5)
    elsewhere = agent.robot.qpos.clone()
    elsewhere[0, 3] += 0.3  # 0.3 rad about the first joint moves the TCP by more than 10 cm
    agent.robot.set_qpos(elsewhere)
    there = matrix(agent.tcp.pose)
    env.step(np.array([0, 0, 0.1, 0, 0, 0, 1], np.float32))
    translation, _ = moved(there, matrix(agent.tcp.pose))
    assert np.linalg.norm(translation) < 0.02


def velocities(agent) -> np.ndarray:
    return agent.robot.drive_velocities[0].numpy()


def test_ee_deltas_set_velocity_targets_which_resets_and_other_modes_clear(make_env):
    env, agent = make_env("pd_ee_delta_pose", control_freq=5)
    assert agent.controller.sets_target_qvel  # else a GPU would not hear of it
    env.step(np.array([0, 0, -0.3, 0, 0, 0, 1], np.float32))
    assert np.abs(velocities(agent)).max() > 0.05
    env.step(np.array([0, 0, 0, 0, 0, 0, 1], np.float32))
    assert np.abs(velocities(agent)).max() < 0.02
    for take_back in (lambda: agent.reset(agent.robot.qpos), lambda: agent.set_control_mode("pd_joint_pos")):
        env.step(np.array([0, 0, -0.3, 0, 0, 0, 1], np.float32))
        take_back()
        assert not velocities(agent).any()


def test_ee_deltas_start_at_the_current_pose_after_the_state_was_set(make_env):
    env, agent = make_env("pd_ee_delta_pose", control_freq=5)
    before, start = agent.robot.qpos.clone(), matrix(agent.tcp.pose)
    for _ in range(2):
        env.step(np.array([0, 0, -0.3, 0, 0, 0, 1], np.float32))
    agent.robot.set_qpos(before)
    agent.robot.set_qvel(torch.zeros_like(before))
    agent.controller.set_targets()
    env.step(np.zeros(7, np.float32))
    translation, _ = moved(start, matrix(agent.tcp.pose))
    assert np.linalg.norm(translation) < 2e-3


def test_ee_delta_rotation_is_clipped_by_norm(make_env):
    env, agent = make_env("pd_ee_delta_pose", control_freq=5)
    start = matrix(agent.tcp_in_arm_base)
    env.step(np.array([0, 0, 0, 1, 0, 1, 1], np.float32))
    target = matrix(agent.controller.controllers["arm"]._target_pose)
    expected = Rotation.from_euler("XYZ", np.array([1, 0, 1]) / np.sqrt(2) * 0.5)
    assert (start[:3, :3].T @ target[:3, :3]) == pytest.approx(expected.as_matrix(), abs=1e-5)
