"""The static camera sees the task in all kinds of furniture."""

import gymnasium as gym
import numpy as np
import pytest

import robocas_ms3  # noqa: F401
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.tasks import TASKS

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    "name", ["pick_table_scattered", "select_shelf_orderly", "pick_refrigerator_open", "open_pick_cabinet_door"]
)
def test_target_and_handle_are_in_view_of_the_static_camera(name):
    task = load_task_config(name).task
    env = gym.make(TASKS[task].env_id, config=name, render_backend="none", control_mode="pd_joint_pos")
    env.reset(seed=1)
    base = env.unwrapped
    config = next(config for config in base.agent._sensor_configs if config.uid == "static_camera")
    camera = config.pose.sp.to_transformation_matrix()
    target = base.object_poses[0, int(base.target_slot[0]), :3].numpy()
    forward, left, up = (target - camera[:3, 3]) @ camera[:3, :3]
    assert max(abs(left), abs(up)) < 0.7 * forward  # of 1, the edge of an image of 90 deg
    assert 0.5 < forward < 2.0
    if config.pose.p[0].tolist() != pytest.approx([1, 1.5, 1.5]):  # RoboCAS-v0's camera is across the table
        robot = base.model.robot_pose
        in_front = (robot[:3, :3].T @ (camera[:3, 3] - target))[0]
        assert in_front < 0  # on the robot's side
    assert np.isclose(camera[:3, 0] @ camera[:3, 1], 0, atol=1e-6)
    env.close()
