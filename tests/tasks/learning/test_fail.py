"""Where the target or the basket has fallen, an episode ends in failure."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import torch
from learning_envs import STATE_ONLY, held_still, put, target_of
from mani_skill.utils.structs import Pose

import robocas_ms3  # noqa: F401


def test_a_target_on_the_floor_is_a_failure_that_ends_the_episode(env):
    env.reset(seed=0)
    base = env.unwrapped
    put(target_of(base), [-1.0, -1.0, 0.1])
    _, reward, terminated, _, info = env.step(held_still(env))
    assert (reward.item(), bool(terminated), bool(info["fail"]), bool(info["success"])) == (0, True, True, False)
    put(target_of(base), base.start_poses[0, int(base.target_slot[0]), :3])
    assert not base.get_info()["fail"]


def test_a_basket_that_fell_is_a_failure_and_one_that_was_pushed_is_none(env):
    env.reset(seed=0)
    base = env.unwrapped
    basket, at = base.fixtures.basket, base.fixtures.basket.pose.p.clone()
    put(basket, at + torch.tensor([0, 0.2, 0]))
    assert not base.get_info()["fail"]
    put(basket, at + torch.tensor([0.8, 0, -0.3]))
    assert base.get_info()["fail"]
    basket.set_pose(Pose.create_from_pq(at, torch.tensor([[0.5**0.5, 0.5**0.5, 0, 0]])))
    assert base.get_info()["fail"]


def test_a_basket_below_the_support_is_no_pit():
    env = gym.make("RoboCASPick-v1", config="pick_side_table_scattered", obs_mode="none", **STATE_ONLY)
    env.reset(seed=0)
    base: Any = env.unwrapped
    inside = base.basket_pose[0, :3]
    assert inside[2] < base.success_check.surface - 0.1  # it stands on the floor
    for height, failed in ((0.0, False), (0.3, False)):  # in it; on its way down
        put(target_of(base), inside + torch.tensor([0.1, 0, height]))
        assert bool(base.get_info()["fail"]) is failed
    put(target_of(base), inside + torch.tensor([-0.5, 0.5, 0]))  # beside it
    assert base.get_info()["fail"]
    env.close()


def test_a_failure_ends_an_episode_without_observations_too():
    env = gym.make("RoboCASPick-v1", obs_mode="none", reward_mode="none", **STATE_ONLY)
    env.reset(seed=0)
    put(target_of(env.unwrapped), [-1.0, -1.0, 0.1])
    assert env.step(held_still(env))[2]
    env.close()
