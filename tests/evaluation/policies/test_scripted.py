"""The scripted policy plans again after a disturbance, and moves faster if the episode would end too early."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from mani_skill.utils.structs import Pose

import robocas_ms3  # noqa: F401
from robocas_ms3.evaluation.policies.scripted import MAX_HURRY, ScriptedPolicy, sample_plan
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations
from robocas_ms3.evaluation.rollouts.action_wrapper import V0_CONTROL_HZ, PolicyActionWrapper, make_env_kwargs
from robocas_ms3.evaluation.rollouts.rollout import EndConditions, EpisodeBatch, Rollout, run_rollouts
from robocas_ms3.tasks.vector import RoboCASVectorEnv

CONFIG, SEED, MAX_STEPS = "pick_upstream_eval", 2, 150
OPEN, CLOSED = 1.0, -1.0


def test_plan_is_sampled_evenly_and_before_each_change_of_the_gripper():
    """Action 6 is the first that closes, so state 6 is the last before it."""
    gripper = np.array([OPEN] * 6 + [CLOSED] * 6)
    assert sample_plan(gripper, 4, None).tolist() == [0, 4, 6, 8, 12]
    assert sample_plan(np.array([OPEN] * 10), 4, None).tolist() == [0, 3, 7, 10]  # 3 steps, none longer than 4 states
    assert sample_plan(np.array([OPEN] * 3), 1, None).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("max_steps", "steps"), [(60, 50), (50, 50), (40, 40), (10, 50 / MAX_HURRY)])
def test_long_plan_has_as_many_steps_as_the_episode_up_to_the_greatest_speed(max_steps, steps):
    samples = sample_plan(np.full(200, OPEN), 4, max_steps)
    assert len(samples) - 1 == steps
    assert (samples[0], samples[-1]) == (0, 200)


class Disturbed(ScriptedPolicy):
    """Scripted policy whose env is disturbed: ``disturb`` gets the step and the action, and returns the action."""

    def __init__(self, disturb: Callable[[int, np.ndarray], np.ndarray]) -> None:
        super().__init__("robocas")
        self._disturb = disturb

    def act(self, observations: Observations) -> np.ndarray:
        assert observations.simulation is not None
        return self._disturb(observations.simulation[0].steps, super().act(observations))


@pytest.fixture
def env() -> Iterator[Any]:
    made = gym.make(
        "RoboCASPick-v1", config=CONFIG, sim_backend="physx_cpu", **make_env_kwargs(ScriptedPolicy("robocas").spec, 5)
    )
    yield made
    made.close()


def run(env: Any, disturb: Callable[[int, np.ndarray], np.ndarray]) -> Rollout:
    policy = Disturbed(disturb)
    options = {"auto_reset": False, "ignore_terminations": True, "record_metrics": False}
    vector = RoboCASVectorEnv(PolicyActionWrapper(env, policy.spec, "upstream"), "numpy", **options)
    vector.reset(seed=[SEED])
    batch = EpisodeBatch(vector, policy.spec, EndConditions(MAX_STEPS), 1 / V0_CONTROL_HZ, refill=False)
    spec = EpisodeSpec(-1, 0, "pick", CONFIG, "auto", "builtin", SEED, "", max_steps=MAX_STEPS)
    (ended,) = run_rollouts(batch, policy, [spec])
    policy.close()
    return ended


@pytest.mark.slow
@pytest.mark.parametrize("step", [8, 32])
def test_policy_grasps_a_target_that_was_knocked_away(env, step):
    """The target is moved by 7 cm on the table, before the grasp and while it is carried."""

    def knock(now: int, actions: np.ndarray) -> np.ndarray:
        if now == step:
            base: Any = env.unwrapped
            slot = int(base.target_slot[0])
            pose = base.start_poses[:, slot].clone()
            pose[:, 0] -= 0.07
            base.objects[slot].set_pose(Pose.create(pose))
            base.objects[slot].set_linear_velocity(np.zeros(3))
        return actions

    assert run(env, knock).flags["success"] is not None


@pytest.mark.slow
def test_policy_continues_after_another_policy(env):
    """Random motions with a closed gripper replace the actions of 20 steps."""
    rng = np.random.default_rng(0)

    def act_randomly(now: int, actions: np.ndarray) -> np.ndarray:
        if 10 <= now < 30:
            return np.concatenate([rng.uniform(-0.05, 0.05, (1, 3)), rng.uniform(-0.2, 0.2, (1, 3)), [[0]]], axis=1)
        return actions

    assert run(env, act_randomly).flags["success"] is not None
