from __future__ import annotations

import numpy as np
import pytest
import sapien
import torch
from mani_skill.agents.controllers import PDJointPosController
from mani_skill.utils.geometry.rotation_conversions import matrix_to_quaternion
from mani_skill.utils.structs import Pose
from scipy.spatial.transform import Rotation

from robocas_ms3.robots import constants as c
from robocas_ms3.robots.ee_controller import batched_ik
from robocas_ms3.robots.ee_deltas import ee_delta_target, to_ee_delta_action

MODES = {"pd_joint_pos": 8, "pd_joint_delta_pos": 8, "pd_ee_delta_pose": 7, "pd_ee_pose": 7}
ALL_MODES = {**MODES, **{f"{mode}_base": size + 3 for mode, size in MODES.items()}}


def matrix(pose: Pose) -> np.ndarray:
    return pose.sp.to_transformation_matrix()


def moved(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Translation and rotation vector of a motion, in the frame at its start."""
    relative = np.linalg.inv(start) @ end
    return relative[:3, 3], Rotation.from_matrix(relative[:3, :3]).as_rotvec()


# Maths, without a simulation.


def test_delta_is_applied_in_the_end_effectors_frame():
    half = np.sqrt(0.5)
    position = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    quaternion = torch.tensor([[half, 0.0, 0.0, half], [0.0, 1.0, 0.0, 0.0]])  # yaw 90 deg; upside down about x
    delta = torch.tensor([[0.1, 0.0, 0.0, 0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.2, np.pi / 2, 0.0, 0.0]]).float()
    p, q = ee_delta_target(position, quaternion, delta)
    assert p.numpy() == pytest.approx(np.array([[1.0, 2.1, 3.0], [0.0, 0.0, -0.2]]), abs=1e-6)
    assert q[0].abs().numpy() == pytest.approx([0, 0, 0, 1], abs=1e-6)  # 90 + 90 deg about z
    assert q[1].abs().numpy() == pytest.approx([half, half, 0, 0], abs=1e-6)  # 180 + 90 deg about x
    assert q[1, 0] * q[1, 1] < 0  # 270 deg, not 90


def test_action_of_a_motion_leads_to_that_motion():
    rng = np.random.default_rng(0)
    translation, rotvec = rng.uniform(-0.1, 0.1, (20, 3)), rng.uniform(-0.25, 0.25, (20, 3))
    action = to_ee_delta_action(translation, rotvec)
    assert action.shape == (20, 6)
    assert action[:, :3] == pytest.approx(translation / 0.1, rel=1e-5)
    start = Rotation.random(20, random_state=1)
    quaternion = torch.tensor(start.as_quat()[:, [3, 0, 1, 2]]).float()
    scaled = torch.tensor(action) * torch.tensor([0.1] * 3 + [0.5] * 3)
    p, q = ee_delta_target(torch.zeros(20, 3), quaternion, scaled)
    reached = Rotation.from_quat(q.numpy()[:, [1, 2, 3, 0]])
    assert (start.inv() * reached).as_rotvec() == pytest.approx(rotvec, abs=1e-5)
    assert p.numpy() == pytest.approx(start.apply(translation), abs=1e-6)


def test_euler_conventions_are_told_apart():
    angles = np.array([0.3, 0.2, 0.1])
    assert to_ee_delta_action(np.zeros(3), angles, euler="XYZ")[3:] == pytest.approx(angles / 0.5)
    extrinsic = Rotation.from_euler("xyz", angles)
    assert to_ee_delta_action(np.zeros(3), angles, euler="xyz") == pytest.approx(
        to_ee_delta_action(np.zeros(3), extrinsic)
    )
    assert np.abs(to_ee_delta_action(np.zeros(3), extrinsic)[3:] - angles / 0.5).max() > 0.02


# The controllers, in an empty environment; the robot stands turned by 90 deg.


@pytest.mark.parametrize("mode", ALL_MODES)
def test_action_dimensions_and_the_base(make_env, mode):
    env, agent = make_env(mode)
    assert env.action_space.shape == (ALL_MODES[mode],)
    assert agent.supported_control_modes == list(ALL_MODES)
    assert agent.supported_control_modes[0] == "pd_joint_pos"
    assert {"arm", "gripper"} <= set(agent.controller.controllers)
    action = np.zeros(ALL_MODES[mode], np.float32)
    if "delta" not in mode:
        arm = c.ARM_EVALUATION_START
        if "ee" in mode:
            tcp = matrix(agent.tcp_in_arm_base)
            arm = [*tcp[:3, 3], *Rotation.from_matrix(tcp[:3, :3]).as_euler("XYZ")]
        action[: len(arm)] = arm
    base = [0.0, 0.0, 0.0]
    if mode.endswith("_base"):
        action[-3:] = (1, -1, 0.5) if "delta" in mode else (0.025, -0.025, 0.0125)
        base = [0.025, -0.025, 0.0125]
    env.step(action)
    if "delta" in mode:
        action[:] = 0
    for _ in range(19):
        env.step(action)
    qpos = agent.robot.qpos[0].numpy()
    assert qpos[:3] == pytest.approx(base, abs=1e-3)
    assert qpos[3:10] == pytest.approx(c.ARM_EVALUATION_START, abs=3e-3)


def test_joint_delta_moves_by_a_tenth_of_a_radian(make_env):
    env, agent = make_env("pd_joint_delta_pos", control_freq=5)
    assert type(agent.controller.controllers["arm"]) is PDJointPosController  # ManiSkill's replay asks for the type
    env.step(np.array([0, 0, 0, 0, 1, 0, -0.5, 1], np.float32))
    change = agent.robot.qpos[0, 3:10].numpy() - c.ARM_EVALUATION_START
    assert change[[4, 6]] == pytest.approx([0.1, -0.05], rel=0.15)


@pytest.mark.parametrize("axis", range(6))
def test_ee_delta_moves_along_and_turns_about_the_tcps_own_axes(make_env, axis):
    env, agent = make_env("pd_ee_delta_pose", control_freq=5)
    start = matrix(agent.tcp.pose)
    action = np.zeros(7, np.float32)
    action[axis] = 0.4
    env.step(action)
    translation, rotation = moved(start, matrix(agent.tcp.pose))
    motion = np.concatenate([translation / 0.1, rotation / 0.5])
    assert motion[axis] == pytest.approx(0.4, rel=0.12)
    assert np.abs(np.delete(motion, axis)).max() < 0.06


def test_ee_deltas_add_up_without_the_arms_lag(make_env):
    env, agent = make_env("pd_ee_delta_pose", control_freq=5)
    start = matrix(agent.tcp.pose)
    for _ in range(10):
        env.step(np.array([0, 0, -0.15, 0, 0, 0.1, 1], np.float32))
    for _ in range(5):
        env.step(np.array([0, 0, 0, 0, 0, 0, 1], np.float32))
    translation, rotation = moved(start, matrix(agent.tcp.pose))
    assert translation == pytest.approx([0, 0, -0.15], abs=1e-3)
    assert rotation == pytest.approx([0, 0, 0.5], abs=2e-3)


def test_ee_deltas_start_where_the_arm_is_after_it_was_held_back(make_env):
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


def test_ee_deltas_tell_the_drives_their_velocity_and_other_modes_take_it_back(make_env):
    env, agent = make_env("pd_ee_delta_pose", control_freq=5)
    assert agent.controller.sets_target_qvel  # else a GPU would not hear of it
    env.step(np.array([0, 0, -0.3, 0, 0, 0, 1], np.float32))
    assert np.abs(velocities(agent)).max() > 0.05
    env.step(np.array([0, 0, 0, 0, 0, 0, 1], np.float32))
    assert np.abs(velocities(agent)).max() < 0.02
    env.step(np.array([0, 0, -0.3, 0, 0, 0, 1], np.float32))
    agent.set_control_mode("pd_joint_pos")
    assert not velocities(agent).any()


def test_after_a_reset_the_drives_know_of_no_velocity(make_env):
    env, agent = make_env("pd_ee_delta_pose", control_freq=5)
    env.step(np.array([0, 0, -0.3, 0, 0, 0, 1], np.float32))
    agent.reset(agent.robot.qpos)
    assert not velocities(agent).any()


def test_ee_deltas_start_where_the_arm_is_after_its_state_was_set(make_env):
    env, agent = make_env("pd_ee_delta_pose", control_freq=5)
    before, start = agent.robot.qpos.clone(), matrix(agent.tcp.pose)
    for _ in range(2):
        env.step(np.array([0, 0, -0.3, 0, 0, 0, 1], np.float32))
    agent.robot.set_qpos(before)
    agent.robot.set_qvel(torch.zeros_like(before))
    agent.set_controller_targets()
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


def test_ee_pose_is_in_the_arms_base_frame(make_env):
    env, agent = make_env("pd_ee_pose")
    goal = matrix(agent.tcp_in_arm_base)
    goal[:3, 3] += [0.05, -0.03, -0.1]
    goal[:3, :3] = goal[:3, :3] @ Rotation.from_euler("XYZ", [0.2, -0.3, 0.4]).as_matrix()
    euler = Rotation.from_matrix(goal[:3, :3]).as_euler("XYZ")
    for _ in range(20):
        env.step(np.array([*goal[:3, 3], *euler, 1], np.float32))
    translation, rotation = moved(goal, matrix(agent.tcp_in_arm_base))
    assert np.linalg.norm(translation) < 5e-4
    assert np.linalg.norm(rotation) < 1e-3
    # The robot is turned by 90 deg: the base frame's x is the world's y.
    offset = agent.tcp.pose.p[0].numpy() - [0.7, 0.15, 0.49]
    assert [offset[1], -offset[0], offset[2]] == pytest.approx(goal[:3, 3], abs=1e-3)


def test_unreachable_pose_leaves_the_arm_where_it_is(make_env):
    env, agent = make_env("pd_ee_pose")
    for _ in range(5):
        env.step(np.array([1.9, 0, 0, 0, 0, 0, 1], np.float32))
    assert agent.robot.qpos[0, 3:10].numpy() == pytest.approx(c.ARM_EVALUATION_START, abs=1e-3)


def test_gripper_plus_one_opens_minus_one_closes(make_env):
    env, agent = make_env()
    arm = c.ARM_EVALUATION_START
    for command, width in ((-1.0, 0.0), (1.0, 0.08), (0.2, 0.04)):  # -0.01 + 1.2 * 0.025 = 0.02 each
        for _ in range(15):
            env.step(np.array([*arm, command], np.float32))
        assert agent.gripper_width.item() == pytest.approx(width, abs=1e-3)


def velocity_profile(distance: float, dt: float) -> np.ndarray:
    """Positions at 0.5 rad/s and 0.5 rad/s^2, the last one exact."""
    ramp = min(1.0, np.sqrt(distance / 0.5))
    top = 0.5 * ramp
    end = ramp + distance / top
    fine = np.arange(0, end + 1e-9, 1e-3)
    speed = np.clip(np.minimum(0.5 * fine, 0.5 * (end - fine)), 0, top)
    position = np.concatenate([[0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 1e-3)])
    times = np.arange(1, int(np.ceil(end / dt)) + 1) * dt
    positions = np.interp(times, fine, position)
    positions[-1] = distance
    return positions


@pytest.mark.parametrize("control_freq", [20, 5])
def test_planned_motion_is_tracked_smoothly_and_the_base_is_held(make_env, control_freq):
    env, agent = make_env(control_freq=control_freq)
    start = np.array(c.ARM_EVALUATION_START)
    direction = np.array([1.0, -0.6, 0.8, 0.5, -0.8, -0.9, 1.0])
    qvel, base = [], []

    def watch():
        qvel.append(agent.robot.qvel[0, 3:10].numpy().copy())
        base.append(agent.robot.qpos[0, :3].numpy().copy())

    env.unwrapped._after_simulation_step = watch
    waypoints = start + velocity_profile(1.0, 1 / control_freq)[:, None] * direction
    for qpos in waypoints:
        env.step(np.array([*qpos, 1], np.float32))
    assert np.abs(agent.robot.qpos[0, 3:10].numpy() - waypoints[-1]).max() < 6e-3
    for _ in range(max(1, int(0.3 * control_freq))):
        env.step(np.array([*waypoints[-1], 1], np.float32))
    reached = agent.tcp_in_arm_base.p[0].numpy()
    agent.reset(np.array([0, 0, 0, *waypoints[-1], 0.04, 0.04]))
    assert np.linalg.norm(reached - agent.tcp_in_arm_base.p[0].numpy()) < 2e-3
    assert np.abs(qvel).max() < 0.5 * 1.1  # a target that jumps at 5 Hz doubles the velocity
    assert np.abs(np.diff(qvel, axis=0)).max() * 100 < 3.0  # rad/s^2
    assert np.abs(base)[:, :2].max() < 1e-3
    assert np.abs(base)[:, 2].max() < np.radians(0.1)


def test_base_drives_to_an_absolute_target_at_its_speed_limit(make_env):
    env, agent = make_env("pd_joint_pos_base")
    action = np.array([*c.ARM_EVALUATION_START, 1, 0.3, -0.2, -0.4], np.float32)
    speeds = []
    for _ in range(30):
        env.step(action)
        speeds.append(agent.robot.qvel[0, :3].abs().max().item())
    assert agent.robot.qpos[0, :3].numpy() == pytest.approx([0.3, -0.2, -0.4], abs=1e-3)
    assert 0.45 < max(speeds) < 0.55


def test_reset_sets_the_drive_targets_too(make_env):
    env, agent = make_env()
    qpos = agent.keyframes["rest"].qpos.copy()
    qpos[:3] = [0.2, -0.1, 0.3]
    agent.reset(qpos)
    for _ in range(20):
        env.step(None)
    assert agent.robot.qpos[0].numpy() == pytest.approx(qpos, abs=1e-4)


def test_held_base_stays_where_a_state_put_it(make_env):
    env, agent = make_env()
    action = np.array([*c.ARM_EVALUATION_START, 1], np.float32)
    env.step(action)
    qpos = agent.robot.qpos.clone()
    qpos[0, 0] = 0.1
    agent.robot.set_qpos(qpos)
    for _ in range(10):
        env.step(action)
    assert agent.robot.qpos[0, 0].item() == pytest.approx(0.1, abs=1e-3)


def test_batched_inverse_kinematics_reaches_every_target(make_env):
    """What runs on a GPU, run here on the CPU on a batch."""
    _, agent = make_env("pd_ee_delta_pose")
    controller = agent.controller.controllers["arm"]
    kinematics = controller.kinematics
    kinematics._setup_gpu()

    def forward(arm: torch.Tensor) -> Pose:
        matrices = kinematics.pk_chain.forward_kinematics(arm).get_matrix()
        return Pose.create_from_pq(matrices[:, :3, 3], matrix_to_quaternion(matrices[:, :3, :3]))

    rng = np.random.default_rng(0)
    qpos = agent.robot.qpos.repeat(32, 1)
    bent = np.array([0, -0.3, 0, -2.2, 0, 2.0, 0.78])  # far from the edge of what the arm reaches
    qpos[:, 3:10] = torch.tensor(bent + rng.uniform(-0.2, 0.2, (32, 7))).float()
    now = forward(qpos[:, 3:10])
    delta = torch.tensor(np.hstack([rng.uniform(-0.1, 0.1, (32, 3)), rng.uniform(-0.28, 0.28, (32, 3))])).float()
    target = Pose.create_from_pq(*ee_delta_target(now.p, now.q, delta))
    found, solved = batched_ik(kinematics, target, qpos[:, 3:10], controller._limits)
    reached = forward(found)
    assert solved.all()
    assert (reached.p - target.p).norm(dim=1).max() < 1e-4
    assert (reached.q * target.q).sum(dim=1).abs().min() > 1 - 1e-6


def test_batched_inverse_kinematics_goes_far_too(make_env):
    """Up to half a metre and 1.5 rad along every axis: whatever a CPU reaches, within limits, nearly always."""
    _, agent = make_env("pd_ee_pose")
    controller = agent.controller.controllers["arm"]
    kinematics, limits = controller.kinematics, controller._limits
    kinematics._setup_gpu()
    rng = np.random.default_rng(2)
    start = agent.robot.qpos[:, 3:10].repeat(64, 1)
    middle = torch.tensor(np.array(c.ARM_EVALUATION_START), dtype=torch.float32)
    goal = (middle + torch.tensor(rng.uniform(-0.6, 0.6, (64, 7))).float()).clamp(limits[:, 0], limits[:, 1])
    matrices = kinematics.pk_chain.forward_kinematics(goal).get_matrix()
    target = Pose.create_from_pq(matrices[:, :3, 3], matrix_to_quaternion(matrices[:, :3, :3]))
    _, solved = batched_ik(kinematics, target, start, limits)
    assert (target.p - agent.tcp_in_arm_base.p).norm(dim=1).max() > 0.4
    assert solved.float().mean() > 0.95


def test_batched_inverse_kinematics_keeps_to_the_limits_and_says_what_it_did_not_reach(make_env):
    _, agent = make_env("pd_ee_delta_pose")
    controller = agent.controller.controllers["arm"]
    kinematics, limits = controller.kinematics, controller._limits
    solver, chain, free = kinematics.pmodel, controller._chain, controller._free
    kinematics._setup_gpu()
    rng = np.random.default_rng(1)
    arm = rng.uniform(limits[:, 0], limits[:, 1], (64, 7)).astype(np.float32)  # many near a limit
    qpos = agent.robot.qpos.repeat(64, 1)
    qpos[:, 3:10] = torch.from_numpy(arm)
    matrices = kinematics.pk_chain.forward_kinematics(qpos[:, 3:10]).get_matrix()
    now = Pose.create_from_pq(matrices[:, :3, 3], matrix_to_quaternion(matrices[:, :3, :3]))
    delta = torch.tensor(np.hstack([rng.uniform(-0.1, 0.1, (64, 3)), rng.uniform(-0.28, 0.28, (64, 3))])).float()
    target = Pose.create_from_pq(*ee_delta_target(now.p, now.q, delta))
    target.raw_pose[:4, :3] = torch.tensor([2.0, 0, 0.5])  # out of reach
    found, solved = batched_ik(kinematics, target, qpos[:, 3:10], limits)
    assert ((found >= limits[:, 0]) & (found <= limits[:, 1])).all()
    assert not solved[:4].any()
    on_a_cpu = []
    low, high = limits.numpy().T
    for pose, start in zip(target.raw_pose.numpy(), qpos.numpy(), strict=True):
        qpos_on_a_cpu, success, _ = solver.compute_inverse_kinematics(
            kinematics.end_link_idx,
            sapien.Pose(pose[:3], pose[3:]),
            initial_qpos=start[chain],
            active_qmask=free,
            max_iterations=100,
        )
        reached = qpos_on_a_cpu[controller._arm]
        on_a_cpu.append(bool(success and (reached >= low).all() and (reached <= high).all()))
    both = solved.numpy() & on_a_cpu
    assert both.sum() > 30
    assert both.sum() >= 0.95 * sum(on_a_cpu)
    matrices = kinematics.pk_chain.forward_kinematics(found).get_matrix()
    missed = (matrices[:, :3, 3] - target.p).norm(dim=1)
    assert missed[solved].max() < 1.1e-4
    assert missed[~solved].median() > 1e-3
