"""Dense rewards, failures and privileged observations of environments."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.utils.structs import Pose

import robocas_ms3  # noqa: F401

STATE_ONLY: dict[str, Any] = {"render_backend": "none", "control_mode": "pd_joint_pos"}


def make_hold_action(env, gripper: float = 1.0) -> np.ndarray:
    return np.append(env.unwrapped.agent.robot.get_qpos()[0, 3:10].numpy(), gripper).astype(np.float32)


def target_actor(base) -> Any:
    return base.objects[int(base.target_slot[0])]


def move_actor(actor, position) -> None:
    actor.set_pose(Pose.create_from_pq(torch.as_tensor(position).reshape(1, 3), actor.pose.q))
    actor.set_linear_velocity(torch.zeros(1, 3))
    actor.set_angular_velocity(torch.zeros(1, 3))


def compute_reward(base) -> tuple[float, dict[str, float], dict]:
    info = base.get_info()
    reward = base.get_reward({}, None, info)
    assert reward.shape == (1,)
    assert reward.dtype == torch.float32
    return reward.item(), {name: term.item() for name, term in info["reward_terms"].items()}, info


@pytest.fixture(scope="module")
def env():
    env = gym.make("RoboCASPick-v1", obs_mode="state_dict", reward_mode="normalized_dense", **STATE_ONLY)
    yield env
    env.close()


# ---------------------------------------------------------------------- modes


def test_sparse_is_the_default_and_computes_no_terms():
    env = gym.make("RoboCASPick-v1", obs_mode="none", **STATE_ONLY)
    assert env.unwrapped.reward_mode == "sparse"
    env.reset(seed=0)
    *_, info = env.step(make_hold_action(env))
    assert "reward_terms" not in info
    assert env.unwrapped.dense_reward.last_action is None
    env.close()


def test_dense_is_normalized_dense_times_the_total(env):
    env.reset(seed=0)
    _, reward, *_, info = env.step(make_hold_action(env))
    base = env.unwrapped
    dense = base.compute_dense_reward({}, make_hold_action(env), info)
    assert reward.item() == pytest.approx(dense.item() / base.REWARDS.total)
    weighed = sum(weight * info["reward_terms"][name].item() for name, weight in base.REWARDS.weights.items())
    assert dense.item() == pytest.approx(weighed)
    assert set(info["reward_terms"]) == {*base.REWARDS.weights, *base.REWARDS.penalties}


def test_action_rate_compares_the_last_two_actions(env):
    _, info = env.reset(seed=0)
    first = make_hold_action(env)
    *_, info = env.step(first)
    assert info["reward_terms"]["action_rate"].item() == 0
    second = first.copy()
    second[-1] = -1.0  # one of 8 components, by its whole range
    *_, info = env.step(second)
    assert info["reward_terms"]["action_rate"].item() == pytest.approx(1 / 8)
    env.reset(seed=0)
    *_, info = env.step(first)
    assert info["reward_terms"]["action_rate"].item() == 0


def test_progress_sums_to_the_change_and_swaying_pays_nothing():
    env = gym.make("RoboCASPick-v1", obs_mode="none", reward_mode="progress", **STATE_ONLY)
    env.reset(seed=0)
    base, start = env.unwrapped, make_hold_action(env)
    rewards, levels = [], []
    for k in range(80):
        action = start.copy()
        action[1] += 0.5 * np.sin(2 * np.pi * min(k, 60) / 20)  # three times towards the table and back
        _, reward, *_, info = env.step(action)
        rewards.append(reward.item())
        levels.append(base.dense_reward.last_normalized_reward.item())
    assert rewards[0] == 0
    assert np.sum(rewards) == pytest.approx(levels[-1] - levels[0], abs=1e-5)
    assert np.ptp(levels) > 0.004  # the reward did change
    assert np.sum(rewards) < 0.1 * np.abs(rewards).sum()
    env.reset(seed=1)
    assert env.step(make_hold_action(env))[1].item() == 0
    env.close()


# ---------------------------------------------------------------------- stages, by putting things


def test_reward_grows_with_nearness_to_the_target_only(env):
    env.reset(seed=0)
    base = env.unwrapped
    far = compute_reward(base)[0]
    tcp = base.agent.tcp_pos[0]
    other = next(o for i, o in enumerate(base.objects) if i != int(base.target_slot[0]))
    move_actor(other, tcp - torch.tensor([0, 0, 0.05]))
    assert compute_reward(base)[0] <= far
    move_actor(target_actor(base), tcp - torch.tensor([0, 0, 0.3]))
    near = compute_reward(base)[0]
    move_actor(target_actor(base), tcp)
    at, terms, _ = compute_reward(base)
    assert far < near < at < 0.4
    assert terms["reach"] == pytest.approx(1, abs=0.3)
    assert terms["grasp"] == terms["carry"] == 0


def test_unlifted_target_in_the_basket_has_at_most_the_reward_of_reaching(env):
    env.reset(seed=0)
    base = env.unwrapped
    move_actor(target_actor(base), base.basket_pose[0, :3] + torch.tensor([0, 0, 0.02]))
    assert compute_reward(base)[0] < 0.2
    assert not compute_reward(base)[2]["fail"]


def test_reward_is_1_on_success_and_less_with_a_shifted_basket(env):
    env.reset(seed=0)
    base = env.unwrapped
    base.success_check.stages["target_lifted"][:] = True
    move_actor(target_actor(base), base.basket_pose[0, :3] + torch.tensor([0, 0, 0.02]))
    assert compute_reward(base)[0] == 1.0
    basket, target = base.fixtures.basket, target_actor(base)
    for body in (basket, target):
        move_actor(body, body.pose.p + torch.tensor([0, 0.12, 0]))
    reward, terms, info = compute_reward(base)
    assert not info["success"]
    assert terms["basket_shift"] == 1
    assert 0.8 < reward < 0.9  # the basket was only shifted
    assert not info["fail"]


def test_target_next_to_a_tipped_basket_is_not_above_it(env):
    env.reset(seed=0)
    base = env.unwrapped
    basket, target, at = base.fixtures.basket, target_actor(base), base.basket_pose[0, :3].clone()
    height = target.pose.p[0, 2]
    base.success_check.stages["target_lifted"][:] = True
    for axis in range(1, 3):
        for way in (-1, 1):
            turned = torch.zeros(1, 4)
            turned[0, 0], turned[0, axis] = np.cos(np.radians(59) / 2), way * np.sin(np.radians(59) / 2)
            basket.set_pose(Pose.create_from_pq(at[None], turned))
            for x, y in ((0.25, 0), (0.4, 0), (-0.25, 0), (-0.4, 0), (0, 0.25), (0, 0.4), (0, -0.25), (0, -0.4)):
                move_actor(target, torch.stack([at[0] + x, at[1] + y, height]))
                reward, _, info = compute_reward(base)
                assert not info["fail"]
                assert reward < 0.2  # the reward of reaching from far away


def test_target_on_the_floor_is_a_failure(env):
    env.reset(seed=0)
    base = env.unwrapped
    move_actor(target_actor(base), [-1.0, -1.0, 0.1])
    _, reward, terminated, _, info = env.step(make_hold_action(env))
    assert (reward.item(), bool(terminated), bool(info["fail"]), bool(info["success"])) == (0, True, True, False)
    move_actor(target_actor(base), base.start_poses[0, int(base.target_slot[0]), :3])
    assert not base.get_info()["fail"]


def test_fallen_basket_is_a_failure_and_a_pushed_one_is_not(env):
    env.reset(seed=0)
    base = env.unwrapped
    basket, at = base.fixtures.basket, base.fixtures.basket.pose.p.clone()
    move_actor(basket, at + torch.tensor([0, 0.2, 0]))
    assert not base.get_info()["fail"]
    move_actor(basket, at + torch.tensor([0.8, 0, -0.3]))
    assert base.get_info()["fail"]
    basket.set_pose(Pose.create_from_pq(at, torch.tensor([[0.5**0.5, 0.5**0.5, 0, 0]])))
    assert base.get_info()["fail"]


def test_target_in_a_basket_below_the_support_is_no_failure():
    env = gym.make("RoboCASPick-v1", config="pick_side_table_scattered", obs_mode="none", **STATE_ONLY)
    env.reset(seed=0)
    base: Any = env.unwrapped
    inside = base.basket_pose[0, :3]
    assert inside[2] < base.success_check.surface - 0.1  # the basket stands on the floor
    for height, failed in ((0.0, False), (0.3, False)):  # in it; on its way down
        move_actor(target_actor(base), inside + torch.tensor([0.1, 0, height]))
        assert bool(base.get_info()["fail"]) is failed
    move_actor(target_actor(base), inside + torch.tensor([-0.5, 0.5, 0]))  # next to it
    assert base.get_info()["fail"]
    env.close()


def test_a_failure_ends_an_episode_without_observations_too():
    env = gym.make("RoboCASPick-v1", obs_mode="none", reward_mode="none", **STATE_ONLY)
    env.reset(seed=0)
    move_actor(target_actor(env.unwrapped), [-1.0, -1.0, 0.1])
    assert env.step(make_hold_action(env))[2]
    env.close()


def test_observations_are_in_the_frame_of_the_tcp(env):
    obs, _ = env.reset(seed=2)
    base, extra = env.unwrapped, obs["extra"]
    tcp, target = base.agent.tcp.pose.sp, target_actor(base).pose.sp
    center = target.p + target.to_transformation_matrix()[:3, :3] @ base.target_asset().asset.center_of_mass
    seen = tcp.inv().to_transformation_matrix() @ np.append(center, 1)
    assert extra["tcp_to_target"][0].numpy() == pytest.approx(seen[:3], abs=1e-5)
    drop = tcp.to_transformation_matrix()[:3, :3] @ extra["target_to_drop"][0].numpy() + center
    basket = base.basket_pose[0].numpy()
    assert drop[:2] == pytest.approx(basket[:2], abs=0.02)
    assert 0.1 < drop[2] - basket[2] < 0.3
    assert extra["target_extents"][0].tolist() == pytest.approx(base.target_asset().asset.extents)
    assert list(extra)[:3] == ["object_poses", "target", "basket_pose"]  # their order is fixed


@pytest.mark.parametrize(
    ("env_id", "names"),
    [("RoboCASSearch-v1", ["hidden_fraction"]), ("RoboCASOpenPick-v1", ["opened_fraction", "tcp_to_handle"])],
)
def test_tasks_add_their_observations(env_id, names):
    config = {"RoboCASSearch-v1": "search_table_small_heap"}.get(env_id)
    env = gym.make(env_id, config=config, obs_mode="state_dict", reward_mode="normalized_dense", **STATE_ONLY)
    obs, _ = env.reset(seed=3)
    base: Any = env.unwrapped
    assert list(obs["extra"])[-len(names) - 1 :] == [*names, "tcp_pose"]
    if names[0] == "hidden_fraction":
        assert obs["extra"]["hidden_fraction"].item() == pytest.approx(base.measure_clutter().hidden_fraction.item())
        _, terms, info = compute_reward(base)
        assert bool(info["obstacles_cleared"]) is (terms["reach"] > 0)
        for slot in range(len(base.objects)):
            if slot != int(base.target_slot[0]):
                move_actor(base.objects[slot], [-2.0, slot * 0.3 - 2.0, 0.1])
        reward, terms, _ = compute_reward(base)
        assert terms["clear"] == terms["push_point"] == 1
        assert reward > 4 / 14
    else:
        assert obs["extra"]["opened_fraction"].item() == pytest.approx(0, abs=1e-3)
        furniture, joint = base._opening
        handle = base.handle_position()[0].copy()
        shut = compute_reward(base)
        qpos = furniture.get_qpos().clone()
        qpos[:, joint] = base.model.open_threshold / 2
        furniture.set_qpos(qpos)
        half = compute_reward(base)
        assert (shut[1]["open"], half[1]["open"]) == pytest.approx((0, 0.5), abs=1e-3)
        assert half[0] > shut[0]
        assert np.linalg.norm(base.handle_position()[0] - handle) > 0.1  # the handle moves with the door
        qpos[:, joint] = base.model.open_threshold * 1.01
        furniture.set_qpos(qpos)
        assert compute_reward(base)[0] > 4 / 14
    env.close()
