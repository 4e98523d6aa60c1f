"""Dense rewards of the environments: the modes, and stages with bodies put where they matter."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from learning_envs import STATE_ONLY, held_still, put, reward_now, target_of
from mani_skill.utils.structs import Pose

import robocas_ms3  # noqa: F401

# ---------------------------------------------------------------------- modes


def test_sparse_stays_the_default_and_costs_nothing_else():
    env = gym.make("RoboCASPick-v1", obs_mode="none", **STATE_ONLY)
    assert env.unwrapped.reward_mode == "sparse"
    env.reset(seed=0)
    *_, info = env.step(held_still(env))
    assert "reward_terms" not in info
    assert env.unwrapped.dense_reward.last_action is None
    env.close()


def test_dense_is_normalized_dense_times_the_total(env):
    env.reset(seed=0)
    _, reward, *_, info = env.step(held_still(env))
    base = env.unwrapped
    dense = base.compute_dense_reward({}, held_still(env), info)
    assert reward.item() == pytest.approx(dense.item() / base.REWARDS.total)
    weighed = sum(weight * info["reward_terms"][name].item() for name, weight in base.REWARDS.weights.items())
    assert dense.item() == pytest.approx(weighed)
    assert set(info["reward_terms"]) == {*base.REWARDS.weights, *base.REWARDS.penalties}


def test_the_action_rate_is_that_of_the_last_two_actions(env):
    _, info = env.reset(seed=0)
    first = held_still(env)
    *_, info = env.step(first)
    assert info["reward_terms"]["action_rate"].item() == 0
    second = first.copy()
    second[-1] = -1.0  # one of 8 components, by its whole range
    *_, info = env.step(second)
    assert info["reward_terms"]["action_rate"].item() == pytest.approx(1 / 8)
    env.reset(seed=0)
    *_, info = env.step(first)
    assert info["reward_terms"]["action_rate"].item() == 0


def test_progress_sums_up_to_the_way_gone_and_swaying_earns_nothing():
    env = gym.make("RoboCASPick-v1", obs_mode="none", reward_mode="progress", **STATE_ONLY)
    env.reset(seed=0)
    base, start = env.unwrapped, held_still(env)
    rewards, levels = [], []
    for k in range(80):
        action = start.copy()
        action[1] += 0.5 * np.sin(2 * np.pi * min(k, 60) / 20)  # three times towards the table and back
        _, reward, *_, info = env.step(action)
        rewards.append(reward.item())
        levels.append(base.dense_reward.last_level.item())
    assert rewards[0] == 0
    assert np.sum(rewards) == pytest.approx(levels[-1] - levels[0], abs=1e-5)
    assert np.ptp(levels) > 0.004  # it did come and go
    assert np.sum(rewards) < 0.1 * np.abs(rewards).sum()
    env.reset(seed=1)
    assert env.step(held_still(env))[1].item() == 0
    env.close()


# ---------------------------------------------------------------------- stages, by putting things


def test_the_nearer_the_better_and_only_the_target_counts(env):
    env.reset(seed=0)
    base = env.unwrapped
    far = reward_now(base)[0]
    tcp = base.agent.tcp_pos[0]
    other = next(o for i, o in enumerate(base.objects) if i != int(base.target_slot[0]))
    put(other, tcp - torch.tensor([0, 0, 0.05]))
    assert reward_now(base)[0] <= far
    put(target_of(base), tcp - torch.tensor([0, 0, 0.3]))
    near = reward_now(base)[0]
    put(target_of(base), tcp)
    at, terms, _ = reward_now(base)
    assert far < near < at < 0.4
    assert terms["reach"] == pytest.approx(1, abs=0.3)
    assert terms["grasp"] == terms["carry"] == 0


def test_a_target_thrown_into_the_basket_unlifted_earns_no_more_than_reaching(env):
    env.reset(seed=0)
    base = env.unwrapped
    put(target_of(base), base.basket_pose[0, :3] + torch.tensor([0, 0, 0.02]))
    assert reward_now(base)[0] < 0.2
    assert not reward_now(base)[2]["fail"]


def test_success_is_exactly_one_and_a_shifted_basket_keeps_it_below(env):
    env.reset(seed=0)
    base = env.unwrapped
    base.success_check.stages["target_lifted"][:] = True
    put(target_of(base), base.basket_pose[0, :3] + torch.tensor([0, 0, 0.02]))
    assert reward_now(base)[0] == 1.0
    basket, target = base.fixtures.basket, target_of(base)
    for body in (basket, target):
        put(body, body.pose.p + torch.tensor([0, 0.12, 0]))
    reward, terms, info = reward_now(base)
    assert not info["success"]
    assert terms["basket_shift"] == 1
    assert 0.8 < reward < 0.9  # the basket only stands elsewhere
    assert not info["fail"]


def test_a_tipped_basket_is_not_above_what_lies_beside_it(env):
    env.reset(seed=0)
    base = env.unwrapped
    basket, target, at = base.fixtures.basket, target_of(base), base.basket_pose[0, :3].clone()
    height = target.pose.p[0, 2]
    base.success_check.stages["target_lifted"][:] = True
    for axis in range(1, 3):
        for way in (-1, 1):
            turned = torch.zeros(1, 4)
            turned[0, 0], turned[0, axis] = np.cos(np.radians(59) / 2), way * np.sin(np.radians(59) / 2)
            basket.set_pose(Pose.create_from_pq(at[None], turned))
            for x, y in ((0.25, 0), (0.4, 0), (-0.25, 0), (-0.4, 0), (0, 0.25), (0, 0.4), (0, -0.25), (0, -0.4)):
                put(target, torch.stack([at[0] + x, at[1] + y, height]))
                reward, _, info = reward_now(base)
                assert not info["fail"]
                assert reward < 0.2  # what reaching for it earns from afar
