"""Privileged observations."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from learning_envs import STATE_ONLY, put, reward_now, target_of

import robocas_ms3  # noqa: F401


def test_observations_are_seen_from_the_tcp(env):
    obs, _ = env.reset(seed=2)
    base, extra = env.unwrapped, obs["extra"]
    tcp, target = base.agent.tcp.pose.sp, target_of(base).pose.sp
    center = target.p + target.to_transformation_matrix()[:3, :3] @ base.target_asset().asset.center_of_mass
    seen = tcp.inv().to_transformation_matrix() @ np.append(center, 1)
    assert extra["tcp_to_target"][0].numpy() == pytest.approx(seen[:3], abs=1e-5)
    drop = tcp.to_transformation_matrix()[:3, :3] @ extra["target_to_drop"][0].numpy() + center
    basket = base.basket_pose[0].numpy()
    assert drop[:2] == pytest.approx(basket[:2], abs=0.02)
    assert 0.1 < drop[2] - basket[2] < 0.3
    assert extra["target_extents"][0].tolist() == pytest.approx(base.target_asset().asset.extents)
    assert list(extra)[:3] == ["object_poses", "target", "basket_pose"]  # what was there before keeps its place


@pytest.mark.parametrize(
    ("env_id", "names"),
    [("RoboCASSearch-v1", ["hidden_share"]), ("RoboCASOpenPick-v1", ["opened_share", "tcp_to_handle"])],
)
def test_tasks_add_what_is_theirs(env_id, names):
    config = {"RoboCASSearch-v1": "search_table_small_heap"}.get(env_id)
    env = gym.make(env_id, config=config, obs_mode="state_dict", reward_mode="normalized_dense", **STATE_ONLY)
    obs, _ = env.reset(seed=3)
    base: Any = env.unwrapped
    assert list(obs["extra"])[-len(names) - 1 :] == [*names, "tcp_pose"]
    if names[0] == "hidden_share":
        assert obs["extra"]["hidden_share"].item() == pytest.approx(base.clutter().hidden_share.item())
        _, terms, info = reward_now(base)
        assert bool(info["obstacles_cleared"]) is (terms["reach"] > 0)
        for slot in range(len(base.objects)):
            if slot != int(base.target_slot[0]):
                put(base.objects[slot], [-2.0, slot * 0.3 - 2.0, 0.1])
        reward, terms, _ = reward_now(base)
        assert terms["clear"] == terms["push_point"] == 1
        assert reward > 4 / 14
    else:
        assert obs["extra"]["opened_share"].item() == pytest.approx(0, abs=1e-3)
        furniture, joint = base._opening
        handle = base.handle_in_world()[0].copy()
        shut = reward_now(base)
        qpos = furniture.get_qpos().clone()
        qpos[:, joint] = base.model.opened_position / 2
        furniture.set_qpos(qpos)
        half = reward_now(base)
        assert (shut[1]["open"], half[1]["open"]) == pytest.approx((0, 0.5), abs=1e-3)
        assert half[0] > shut[0]
        assert np.linalg.norm(base.handle_in_world()[0] - handle) > 0.1  # it moves with the door
        qpos[:, joint] = base.model.opened_position * 1.01
        furniture.set_qpos(qpos)
        assert reward_now(base)[0] > 4 / 14
    env.close()
