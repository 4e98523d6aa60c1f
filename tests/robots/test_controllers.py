"""The control modes, in an empty environment; the robot is rotated by 90 deg."""

from __future__ import annotations

import numpy as np
import pytest
from mani_skill.agents.controllers import PDJointPosController
from robot_checks import matrix, moved
from scipy.spatial.transform import Rotation

from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.description_file import chain_poses
from robocas_ms3.robots.ee_deltas import to_ee_delta_action
from robocas_ms3.robots.urdf import make_robot_files

MODES = {"pd_joint_pos": 8, "pd_joint_delta_pos": 8, "pd_ee_delta_pose": 7, "pd_ee_pose": 7}
ALL_MODES = {**MODES, **{f"{mode}_base": size + 3 for mode, size in MODES.items()}}


@pytest.mark.parametrize("mode", ALL_MODES)
def test_action_dimensions_and_the_base(make_env, mode):
    env, agent = make_env(mode)
    assert env.action_space.shape == (ALL_MODES[mode],)
    assert agent.supported_control_modes == list(ALL_MODES)
    assert agent.supported_control_modes[0] == "pd_joint_pos"
    assert {"arm", "gripper"} <= set(agent.controller.controllers)
    action = np.zeros(ALL_MODES[mode], np.float32)
    if "delta" not in mode:
        arm = MOBILE_PANDA.arm_evaluation_start
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
    assert qpos[3:10] == pytest.approx(MOBILE_PANDA.arm_evaluation_start, abs=3e-3)


def test_joint_delta_moves_by_a_tenth_of_a_radian(make_env):
    env, agent = make_env("pd_joint_delta_pos", control_freq=5)
    assert type(agent.controller.controllers["arm"]) is PDJointPosController  # ManiSkill's replay asks for the type
    env.step(np.array([0, 0, 0, 0, 1, 0, -0.5, 1], np.float32))
    change = agent.robot.qpos[0, 3:10].numpy() - MOBILE_PANDA.arm_evaluation_start
    assert change[[4, 6]] == pytest.approx([0.1, -0.05], rel=0.15)


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


def near_a_limit(agent, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """Put an arm joint 0.01 rad before its upper limit; poses of the TCP there and with the joint 0.1 rad beyond."""
    arms = np.array([MOBILE_PANDA.arm_evaluation_start] * 2)
    arms[:, joint - 1] = MOBILE_PANDA.arm_limits[joint - 1][1] + np.array([-0.01, 0.1])
    agent.reset(np.array([0, 0, 0, *arms[0], 0.04, 0.04]))
    agent.controller.reset()
    return tuple(chain_poses(make_robot_files().arm_urdf, MOBILE_PANDA.arm_base_link, MOBILE_PANDA.tcp_link, arms))


def ee_action(mode: str, now: np.ndarray, goal: np.ndarray) -> np.ndarray:
    if mode == "pd_ee_pose":
        return np.array([*goal[:3, 3], *Rotation.from_matrix(goal[:3, :3]).as_euler("XYZ"), 1], np.float32)
    translation, rotation = moved(now, goal)
    return np.append(to_ee_delta_action(translation, rotation), np.float32(1))


@pytest.mark.parametrize("mode", ["pd_ee_pose", "pd_ee_delta_pose"])
def test_a_pose_beyond_the_joint_limits_leaves_the_arm_where_it_is(make_env, mode):
    """The elbow alone sets the distance between shoulder and wrist, so no other joint can make up for its limit."""
    env, agent = make_env(mode)
    now, goal = near_a_limit(agent, 4)
    action, start = ee_action(mode, now, goal), agent.robot.qpos[0, 3:10].numpy().copy()
    for _ in range(10):
        env.step(action)
        assert agent.robot.qpos[0, 3:10].numpy() == pytest.approx(start, abs=1e-3)


@pytest.mark.parametrize("mode", ["pd_ee_pose", "pd_ee_delta_pose"])
def test_other_joints_compensate_for_a_joint_at_its_limit(make_env, mode):
    env, agent = make_env(mode)
    now, goal = near_a_limit(agent, 7)
    action = ee_action(mode, now, goal)
    for _ in range(20):
        env.step(action)
        action = np.array([*np.zeros(6), 1], np.float32) if mode == "pd_ee_delta_pose" else action
    translation, rotation = moved(goal, matrix(agent.tcp_in_arm_base))
    assert np.linalg.norm(translation) < 5e-4
    assert np.linalg.norm(rotation) < 1e-3
    targets = agent.controller.targets()["arm"]["target_qpos"][0].numpy()
    lower, upper = np.array(MOBILE_PANDA.arm_limits, np.float32).T
    assert ((targets >= lower) & (targets <= upper)).all()


def test_gripper_plus_one_opens_minus_one_closes(make_env):
    env, agent = make_env()
    arm = MOBILE_PANDA.arm_evaluation_start
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
    env, agent = make_env(control_freq=control_freq, fresh=True)
    start = np.array(MOBILE_PANDA.arm_evaluation_start)
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
    action = np.array([*MOBILE_PANDA.arm_evaluation_start, 1, 0.3, -0.2, -0.4], np.float32)
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


def test_held_base_stays_where_a_state_was_set(make_env):
    env, agent = make_env()
    action = np.array([*MOBILE_PANDA.arm_evaluation_start, 1], np.float32)
    env.step(action)
    qpos = agent.robot.qpos.clone()
    qpos[0, 0] = 0.1
    agent.robot.set_qpos(qpos)
    for _ in range(10):
        env.step(action)
    assert agent.robot.qpos[0, 0].item() == pytest.approx(0.1, abs=1e-3)
