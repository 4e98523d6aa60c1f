"""Advantages and outcomes, worked out by hand."""

import torch

from robocas_ms3.baselines.ppo.config import PpoConfig
from robocas_ms3.baselines.ppo.rollouts import advantages, outcomes, steps_of


def test_advantages():
    # deltas: 1 + 0.5 * 4 - 2 = 1 and 0 + 0.5 * 2 - 4 = -3 and 2 + 0.5 * 0 - 2 = 0; traces of 0.5 * 0.5
    column = [[1.0], [0.0], [2.0]], [[2.0], [4.0], [2.0]], [[4.0], [2.0], [0.0]]
    reward, value, following = map(torch.tensor, column)
    never = torch.zeros(3, 1, dtype=torch.bool)
    assert advantages(reward, value, following, never, 0.5, 0.5).flatten().tolist() == [0.25, -3.0, 0.0]


def test_what_comes_after_an_end_counts_for_nothing_before_it():
    reward, value, following = torch.zeros(2, 2), torch.zeros(2, 2), torch.zeros(2, 2)
    reward[1] = 1.0
    over = torch.tensor([[True, False], [False, False]])
    assert advantages(reward, value, following, over, 0.5, 0.5).tolist() == [[0.0, 0.25], [1.0, 1.0]]


def test_what_was_to_come_when_time_was_up_counts():
    reward, value, following = torch.zeros(1, 1), torch.zeros(1, 1), torch.full((1, 1), 3.0)
    assert advantages(reward, value, following, torch.ones(1, 1, dtype=torch.bool), 0.5, 0.9).item() == 1.5


def test_outcomes_are_those_of_the_envs_that_ended():
    final = {
        "episode": {"return": torch.tensor([4.0, 2.0, 1.0])},
        "reward_terms": {"grasp": torch.tensor([1.0, 0.0, 1.0])},
        "target_lifted": torch.tensor([True, False, False]),
        "success": torch.tensor([False, False, False]),
    }
    info = {"final_info": final, "_final_info": torch.tensor([True, False, True])}
    assert outcomes(info).tolist() == [[4.0, 1.0, 1.0, 0.0], [1.0, 1.0, 0.0, 0.0]]


def test_steps_are_shared():
    default = PpoConfig()
    assert steps_of(default) == 512 // 8
    few = PpoConfig(envs=8, train=default.train.model_copy(update={"batch_size": 4}))
    assert steps_of(few) == 1
