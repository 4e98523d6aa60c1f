"""The camera pose of the policies equals the pose that is rendered."""

import gymnasium as gym
import numpy as np
import pytest

import robocas_ms3.tasks  # noqa: F401
from robocas_ms3.planning.scene import PlanningScene
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.look import _camera_shift, camera_in_base
from robocas_ms3.scenes.config import load_task_config

pytestmark = pytest.mark.slow


class Looking(Arm):
    """Arm without motions."""

    def __init__(self, env):
        self._env, self.scene = env, PlanningScene(env)

    env = property(lambda self: self._env)


def look(**options):
    """Return the arm of a search env with random camera motions."""
    config = load_task_config("search_table_small_heap").model_dump(mode="json")
    config["randomisation"]["cameras"] = {"position": 0.1, "rotation_deg": 15}
    made = gym.make("RoboCASSearch-v1", config=config, obs_mode="none", **options)
    made.reset(seed=1)
    return Looking(made.unwrapped)


def test_camera_pose_includes_the_random_shift():
    arm = look()
    rendered = arm.env._sensors["gripper_camera"].camera._render_cameras[0].global_pose.to_transformation_matrix()
    pose, shift = arm.scene.arm_base_in_world @ camera_in_base(arm), _camera_shift(arm)
    arm.env.close()
    assert pose == pytest.approx(rendered, abs=1e-4)
    assert np.linalg.norm(shift[:3, 3]) > 0.02


def test_camera_pose_is_the_same_without_a_renderer():
    """Demonstrations are planned in environments without cameras."""
    poses = []
    for options in ({}, {"render_backend": "none"}):
        arm = look(**options)
        poses.append(camera_in_base(arm))
        arm.env.close()
    assert poses[1] == pytest.approx(poses[0], abs=1e-5)
