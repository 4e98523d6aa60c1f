"""Stage ``furniture_opened``, pulls of handles, and base motion in actions and recordings."""

from __future__ import annotations

from contextlib import contextmanager

import gymnasium as gym
import numpy as np
import pytest

import robocas_ms3  # noqa: F401
from robocas_ms3.core.errors import PlanningError
from robocas_ms3.datasets.sources.arrays import make_episode_arrays
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.open_loop import OpenLoopChecks
from robocas_ms3.demos.recordings.motion import sample_states
from robocas_ms3.demos.recordings.subgoals import sample_subgoals
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile
from robocas_ms3.demos.settings import EpisodeSettings, ReplaySettings
from robocas_ms3.demos.trajectory_replay import replay
from robocas_ms3.planning.executor import MotionExecutor
from robocas_ms3.planning.skills.base_placement import drive_to_handle
from robocas_ms3.planning.skills.drive import current_base_pose, drive
from robocas_ms3.planning.skills.grasp import grasp_candidates, plan_grasp
from robocas_ms3.planning.skills.handles import MovingPart, estimate_pull_fraction, open_furniture_part
from robocas_ms3.scenes.config import bundled_configs, load_task_config
from robocas_ms3.scenes.language.templates import make_subgoal

pytestmark = pytest.mark.slow

STATE_ONLY = {"render_backend": "none", "control_mode": "pd_joint_pos", "obs_mode": "none"}
CONFIGS = ["open_pick_container", "open_pick_refrigerator"]  # sliding and hinged


@pytest.mark.parametrize("name", CONFIGS)
def test_furniture_is_open_from_the_configured_fraction(name):
    assert name in bundled_configs()
    env = gym.make("RoboCASOpenPick-v1", config=name, **STATE_ONLY)
    env.reset(seed=0)
    base = env.unwrapped
    assert not bool(base.evaluate()["furniture_opened"][0])
    furniture = base.fixtures.furniture[base.task_config.opening.furniture]
    index = [joint.name for joint in furniture.active_joints].index(base.model.joint_to_open.name)
    share = base.task_config.opening.opened_at
    assert share >= 0.5
    for factor, opened in ((0.98, False), (1.02, True)):
        qpos = furniture.get_qpos()
        qpos[:, index] = factor * share * max(base.model.joint_to_open.limits, key=abs)
        furniture.set_qpos(qpos)
        assert bool(base.is_furniture_open()[0]) is opened
    env.close()


@contextmanager
def accept_unfinished_episodes():
    """Make the generator accept episodes that end before the task is solved."""
    flag = MotionExecutor.is_flag_set
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MotionExecutor, "is_flag_set", lambda self, name: name == "success" or flag(self, name))
        patch.setattr(OpenLoopChecks, "check", lambda *_, **how: None)
        yield


@pytest.fixture(scope="module")
def drive_recording(tmp_path_factory):
    """Record an episode in which the base drives 0.2 m forward and 0.1 m right, and turns by 0.3 rad."""
    folder = tmp_path_factory.mktemp("driven")
    generator = EpisodeGenerator(EpisodeSettings("open_pick", "open_pick_cabinet_door", "builtin", max_attempts=1))
    seen = {}

    def policy(arm) -> None:
        arm.executor.start_subgoal(**make_subgoal("operate the target", "object", "cabinet"))
        drive(arm, np.array([0.2, -0.1, 0.3]))
        seen["arm"], seen["base"] = arm.scene.arm_qpos - arm.qpos, arm.scene.arm_base_in_world

    generator.policy = policy
    with accept_unfinished_episodes():
        result = generator.generate(0, folder, "driven")
    assert result.success
    seen["root"] = generator.env.unwrapped.model.robot_pose
    generator.close()
    return folder / "driven.h5", seen


def test_recorded_actions_contain_the_drive_and_the_arm_is_still(drive_recording):
    path, seen = drive_recording
    with TrajectoryFile(path) as file:
        actions = file.read_recording(0).actions
    assert actions.shape[1] == 11
    base = actions[:, 8:]
    assert base[-1] == pytest.approx([0.2, -0.1, 0.3], abs=1e-6)
    assert np.abs(np.diff(base, axis=0)).max() <= 0.5 / 20  # m or rad a step of 20 Hz
    assert np.ptp(actions[:, :7], axis=0) == pytest.approx(0, abs=1e-6)
    assert np.abs(seen["arm"]).max() < 0.02
    # the root is turned by half a turn: ahead is -x in the world, right is +y
    moved = (np.linalg.inv(seen["root"]) @ seen["base"])[:2, 3]
    assert moved == pytest.approx([0.2, -0.1], abs=0.01)


def test_base_motion_of_the_dataset_contains_the_drive(drive_recording):
    path, seen = drive_recording
    with TrajectoryFile(path) as file:
        recording = file.read_recording(0)
    samples = sample_states(recording.control_steps, 4)
    motion = recording.compute_motion(samples)
    x, y, yaw = motion.agv_pose.T
    base = np.tile(np.eye(4), (len(x), 1, 1))  # as rendering reads it from the arm's base link
    base[:, 0, 0] = base[:, 1, 1] = np.cos(yaw)
    base[:, 1, 0] = np.sin(yaw)
    base[:, 0, 1] = -base[:, 1, 0]
    base[:, :3, 3] = np.column_stack([x, y, np.full(len(x), 0.49)])
    assert base[-1] == pytest.approx(seen["base"], abs=0.02)
    assert motion.arm_base_in_world == pytest.approx(base, abs=1e-5)
    arrays = make_episode_arrays(motion, "", sample_subgoals(recording.subgoals, samples))
    steps = np.linalg.norm(arrays["base_rel_pos"], axis=1)
    assert steps.max() > 0.02
    assert steps.sum() == pytest.approx(np.hypot(0.2, 0.1), abs=0.02)
    (again,) = replay(ReplaySettings(path))
    assert again.state_error == 0.0


def record_contacts(arm) -> dict[str, float]:
    """Return a dictionary that later steps fill: touched body -> greatest overlap with the robot, m."""
    touched: dict[str, float] = {}
    step = arm.executor._step
    robot = {link._objs[0].entity.name for link in arm.env.agent.robot.links}

    def watched(action) -> None:
        step(action)
        for contact in arm.env.scene.get_contacts():
            names = {body.entity.name for body in contact.bodies}
            depths = [-point.separation for point in contact.points if np.linalg.norm(point.impulse) > 0]
            if depths and len(names & robot) == 1:
                (other,) = names - robot
                touched[other] = max(*depths, touched.get(other, 0.0), 0.0)

    arm.executor._step = watched
    return touched


def test_pull_opens_by_contact_and_releases_the_handle(tmp_path):
    generator = EpisodeGenerator(EpisodeSettings("open_pick", "open_pick_container", "builtin", max_attempts=1))

    def policy(arm) -> None:
        part, touched = MovingPart.from_task(arm), record_contacts(arm)
        assert part.joint_position(arm) == pytest.approx(0, abs=1e-3)
        open_furniture_part(arm)
        assert set(touched) == {part.handle.link}  # and nothing else in the scene
        assert touched[part.handle.link] < 0.002
        assert part.joint_position(arm) == pytest.approx(0.95 * part.open_limit, abs=0.01)
        assert bool(arm.env.is_furniture_open()[0])
        # the gripper is open and off the handle
        bar = part.poses_in_world(arm, np.array([part.joint_position(arm)]))[0] @ part.grasp_in_part
        assert (np.linalg.inv(bar) @ arm.scene.arm_base_in_world @ arm.scene.tcp_in_base)[2, 3] < -0.05
        arm.planner.set_scene(arm.scene.obstacles())
        assert arm.planner.find_collisions(arm.scene.arm_qpos) == []
        assert int(arm.env.evaluate()["disturbed"][0]) == 0

    generator.policy = policy
    with accept_unfinished_episodes():
        assert generator.generate(0, tmp_path, "pulled").success
    generator.close()


def move_robot_back(name: str, distance: float) -> dict:
    """Return a bundled configuration with ``base_motion`` and the robot moved back by ``distance`` m."""
    config = load_task_config(name).model_dump(mode="json")
    robot = config["robot"]
    yaw = np.deg2rad(robot.get("yaw_deg", 0.0))
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    robot["position"] = (np.array(robot["position"]) - distance * ahead).tolist()
    config["target"]["max_distance"] = 1.5
    return config | {"base_motion": True}


def test_robot_drives_to_a_handle_out_of_reach(tmp_path):
    config = move_robot_back("open_pick_container", 0.5)
    generator = EpisodeGenerator(EpisodeSettings("open_pick", config, "builtin", max_attempts=1))

    def measure_pull(arm) -> float:
        part = MovingPart.from_task(arm)
        others = arm.scene.obstacles(exclude_link=(part.furniture, part.handle.link))
        return estimate_pull_fraction(arm, part, arm.scene.arm_base_in_world, others)

    def policy(arm) -> None:
        assert measure_pull(arm) < 0.5
        drive_to_handle(arm)
        assert current_base_pose(arm)[0] > 0.1
        stands = current_base_pose(arm)  # within comfortable reach, the base stops
        drive_to_handle(arm)
        assert (current_base_pose(arm) == stands).all()

    generator.policy = policy
    with accept_unfinished_episodes():
        assert generator.generate(0, tmp_path, "driven").success
    generator.close()


def test_robot_drives_to_a_target_out_of_reach(tmp_path):
    config = move_robot_back("pick_table_scattered", 0.4)
    settings = EpisodeSettings("pick", config, "builtin", max_attempts=4)
    generator = EpisodeGenerator(settings)
    pick = generator.policy

    def policy(arm) -> None:
        with pytest.raises(PlanningError):
            plan_grasp(arm, arm.target, 0.1, grasp_candidates(arm, arm.target, 0))
        pick(arm)

    generator.policy = policy
    assert generator.generate(3, tmp_path, "far").success
    generator.close()
    with TrajectoryFile(tmp_path / "far.h5") as file:
        actions = file.read_recording(0).actions
    base = actions[:, 8:]
    assert base[-1, 0] > 0.1
    driving = np.flatnonzero(np.abs(np.diff(base, axis=0)).max(axis=1) > 0)
    assert len(driving) > 10
    assert np.abs(np.diff(actions[:, :7], axis=0))[driving].max() == 0  # the arm is still
