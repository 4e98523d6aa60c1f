"""Advantages and outcomes of rollouts."""

import torch
from stub_envs import LeftOrRight

from robocas_ms3.baselines.ppo.agent import Agent
from robocas_ms3.baselines.ppo.config import PpoConfig
from robocas_ms3.baselines.ppo.train import (
    OUTCOMES,
    RolloutCollector,
    compute_advantages,
    read_outcomes,
)


def test_advantages():
    """The end of an episode stops the sum; 0.25 is discount times lambda."""
    deltas = torch.tensor([[1.0, 0.0, 0.0], [-3.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    truncated = torch.zeros(3, 3, dtype=torch.bool)
    truncated[0, 1] = True
    assert compute_advantages(deltas, truncated, 0.25).T.tolist() == [
        [0.25, -3.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.25, 1.0, 0.0],
    ]


def test_value_after_a_truncation_counts():
    """Episodes end by a time limit, so the last step has a future value."""
    config = PpoConfig(envs=1, gamma=0.5, gae_lambda=0.0, train={"batch_size": LeftOrRight.STEPS})
    agent = Agent(1, 1, 4)
    torch.nn.init.zeros_(agent.critic[-1].weight)
    torch.nn.init.constant_(agent.critic[-1].bias, 3.0)
    collector = RolloutCollector(LeftOrRight(1), agent, config, 0, torch.empty(0, len(OUTCOMES)))
    rollout = collector.collect_rollout()
    reward = (rollout.obs * rollout.action)[:, 0].clamp(-1, 1)
    torch.testing.assert_close(rollout.advantage, reward + 0.5 * 3 - 3)
    assert collector.episodes == 1
    assert collector.last_outcomes()[0, 0] == reward.sum()


def test_outcomes_of_ended_envs():
    final = {
        "episode": {"return": torch.tensor([4.0, 2.0, 1.0])},
        "reward_terms": {"grasp": torch.tensor([1.0, 0.0, 1.0])},
        "target_lifted": torch.tensor([True, False, False]),
        "success": torch.tensor([False, False, False]),
    }
    info = {"final_info": final, "_final_info": torch.tensor([True, False, True])}
    assert read_outcomes(info).tolist() == [[4.0, 1.0, 1.0, 0.0], [1.0, 1.0, 0.0, 0.0]]
