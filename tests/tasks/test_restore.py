"""A restored state in the middle of an episode has the last commanded pose and the reached stages."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch

import robocas_ms3  # noqa: F401
from robocas_ms3.robots.description import MOBILE_PANDA

MODES = ("pd_joint_pos", "pd_joint_delta_pos", "pd_ee_delta_pose", "pd_ee_pose", "pd_joint_pos_base")
FREE_FALL = 1e-5  # m, rad: only contacts are computed again


@pytest.fixture
def env(request):
    mode = getattr(request, "param", MODES[0])
    made = gym.make("RoboCASPick-v1", obs_mode="state_dict", control_mode=mode, render_backend="none")
    yield made
    made.close()


def make_small_motions(env, count: int, seed: int) -> list[np.ndarray]:
    """Return ``count`` actions that move the arm a little, in the control mode of the environment."""
    rng, mode = np.random.default_rng(seed), env.unwrapped.control_mode
    size = env.action_space.shape[0]
    if mode == "pd_ee_pose":
        tcp = env.unwrapped.agent.tcp_in_arm_base
        start = np.concatenate([tcp.p[0].numpy(), [np.pi, 0, 0]])
        drift = np.cumsum(rng.uniform(-0.005, 0.005, (count, 6)), axis=0)
        return [np.append(start + step, -1).astype(np.float32) for step in drift]
    if "delta" in mode:
        return list(rng.uniform(-0.3, 0.3, (count, size)).astype(np.float32))
    drift = np.cumsum(rng.uniform(-0.02, 0.02, (count, size)), axis=0)
    rest = np.zeros(size)
    rest[:7] = MOBILE_PANDA.arm_rest
    return list((rest + drift).astype(np.float32))


def run_actions(env, todo: list[np.ndarray]) -> tuple[torch.Tensor, dict, dict]:
    for action in todo:
        observation, *_, info = env.step(action)
    return env.unwrapped.agent.robot.get_qpos().clone(), observation, info


@pytest.mark.parametrize("env", MODES, indirect=True)
def test_restored_state_repeats_the_motion(env):
    base = env.unwrapped
    env.reset(seed=0)
    run_actions(env, make_small_motions(env, 10, seed=1))
    kept, seen = base.get_state_dict(), base.get_obs()
    todo = make_small_motions(env, 10, seed=2)
    after, observation, _ = run_actions(env, todo)
    run_actions(env, make_small_motions(env, 7, seed=3))
    base.set_state_dict(kept)
    again = base.get_obs()
    for part, value in seen["agent"].items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(again["agent"][part], value, atol=1e-6, rtol=0, msg=part)
    for name, targets in seen["agent"].get("controller", {}).items():  # equal to the controller's targets
        for what, value in targets.items():
            torch.testing.assert_close(again["agent"]["controller"][name][what], value, atol=1e-6, rtol=0)
    restored, same, _ = run_actions(env, todo)
    assert (restored - after).abs().max() < FREE_FALL
    torch.testing.assert_close(
        same["agent"]["tcp_in_arm_base"], observation["agent"]["tcp_in_arm_base"], atol=1e-5, rtol=0
    )


def test_stages_are_restored(env):
    base = env.unwrapped
    env.reset(seed=0)
    base.success_check.reached[0, 0] = True
    kept = base.get_state_dict()
    env.reset(seed=0)
    assert not base.evaluate()[base.STAGES[0]]
    base.set_state_dict(kept)
    assert base.evaluate()[base.STAGES[0]]
    assert not base.evaluate()[base.STAGES[1]]
    base.set_state_dict({kind: kept[kind] for kind in ("actors", "articulations")})  # as in recordings of other tools
    assert base.evaluate()[base.STAGES[0]]


def test_state_without_targets_starts_from_the_robot_pose():
    env = gym.make("RoboCASPick-v1", obs_mode="none", control_mode="pd_ee_delta_pose", render_backend="none")
    base = env.unwrapped
    env.reset(seed=0)
    start = base.get_state_dict()
    for _ in range(5):
        env.step(np.array([0, 0, -0.3, 0, 0, 0, 1], np.float32))
    base.set_state_dict({kind: start[kind] for kind in ("actors", "articulations")})
    targets = base.agent.controller.targets()["arm"]
    assert torch.allclose(targets["target_pose"], base.agent.tcp_in_arm_base.raw_pose, atol=1e-5)
    assert torch.equal(targets["target_qpos"], base.agent.robot.get_qpos()[:, 3:10])
    env.close()
