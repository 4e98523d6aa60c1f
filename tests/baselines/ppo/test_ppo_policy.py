"""Actions and observations of ppo, which are equal in training and evaluation."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from synthetic_observations import observe

from robocas_ms3.baselines.ppo import BASELINE
from robocas_ms3.baselines.ppo.agent import Agent
from robocas_ms3.baselines.ppo.config import PpoConfig
from robocas_ms3.baselines.ppo.environments import expand_action
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policy import CONVENTIONS
from robocas_ms3.evaluation.rollouts.action_wrapper import choose_control_mode
from robocas_ms3.robots.ee_deltas import to_ee_delta_action

FACTS = {"observation_size": 12 + 7 + 1 + 4, "action_size": 5, "rate_hz": 5}


def make_observations(count, state=4):
    return observe(range(count), state=np.zeros((count, state), np.float32))


def policy_with(numbers):
    """Return an agent with constant actions."""
    agent = BASELINE.model(PpoConfig(width=4), FACTS)
    torch.nn.init.zeros_(agent.actor[-1].weight)
    agent.actor[-1].bias.data = torch.tensor(numbers)
    return BASELINE.policy(PpoConfig(width=4), FACTS, agent)


def test_5d_actions_expand_to_7d_actions():
    found = expand_action(torch.tensor([[0.5, -1.0, 2.0, 0.4, 0.1], [0, 0, 0, 0, -0.1]]))
    torch.testing.assert_close(
        found, torch.tensor([[0.25, -0.5, 0.5, 0, 0, 0.2, 1.0], [0, 0, 0, 0, 0, 0, -1.0]]), atol=1e-6, rtol=0
    )


def test_actions_are_equal_in_evaluation_and_training():
    policy = policy_with([0.5, -1.0, 0.3, 0.4, -0.2])
    assert choose_control_mode(policy.spec.convention) == "pd_ee_delta_pose"
    motion = CONVENTIONS[policy.spec.convention].decode(policy.act(make_observations(1)))
    assert isinstance(motion.rotation, Rotation)
    assert motion.open.tolist() == [False]
    again = to_ee_delta_action(motion.translation, motion.rotation)
    learned = expand_action(torch.tensor([[0.5, -1.0, 0.3, 0.4, -0.2]]))
    np.testing.assert_allclose(again, learned[:, :6].numpy(), atol=1e-6)


def test_other_scenes_are_refused():
    with pytest.raises(EvaluationError, match="24 numbers.*30"):
        policy_with([0.0] * 5).act(make_observations(1, state=10))


def test_observations_are_normalised_by_running_statistics():
    agent = Agent(1, 1, 4)
    agent.update_statistics(torch.tensor([[1.0], [3.0]]))
    agent.update_statistics(torch.tensor([[5.0], [7.0]]))
    assert agent.mean.item() == pytest.approx(4, abs=1e-3)
    # mean 4, variance 5
    assert agent.normalize(torch.tensor([[4.0], [4 + 5**0.5], [1000.0]])).flatten().tolist() == pytest.approx(
        [0, 1, 5], abs=1e-3
    )
