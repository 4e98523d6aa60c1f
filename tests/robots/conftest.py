"""An empty environment with the robot."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

ROBOT = "robocas_mobile_panda"
YAW_90 = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]


@pytest.fixture(scope="module")
def make_env():
    """A function that gives ManiSkill's empty environment with the robot, turned by 90 deg, at a keyframe.

    Tests share environments, but for those that ask for a fresh one.
    """
    import mani_skill.envs  # noqa: F401
    import sapien

    import robocas_ms3.robots.agent  # noqa: F401

    made = {}

    def make(control_mode="pd_joint_pos", keyframe="evaluation", *, fresh=False, **options):
        options = {"control_freq": 20, "robot": ROBOT, "obs_mode": "none"} | options
        key = (control_mode, *options.values(), len(made) if fresh else None)
        if key not in made:
            made[key] = gym.make(
                "Empty-v1",
                robot_uids=options["robot"],
                control_mode=control_mode,
                obs_mode=options["obs_mode"],
                render_backend="none",
                sim_config=dict(sim_freq=100, control_freq=options["control_freq"]),
            )
        env = made[key]
        env.reset(seed=0)
        agent = env.unwrapped.agent
        agent.set_control_mode(control_mode)
        agent.robot.set_pose(sapien.Pose([0.7, 0.15, 0], YAW_90))
        agent.reset(agent.keyframes[keyframe].qpos)
        agent.controller.reset()
        return env, agent

    yield make
    for env in made.values():
        env.close()
