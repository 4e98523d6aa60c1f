"""What a GPU works out for several envs, on tensors, is what a CPU works out for one: flags, rewards, observations."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import robocas_ms3  # noqa: F401
from robocas_ms3 import tasks
from robocas_ms3.tasks import TASKS, base, dense, goals, observations, open_pick, search, success

ENVS = 3
PER_ENV = (
    *("present", "target_slot", "start_poses", "basket_at_start", "_centers_of_mass", "extents", "is_target"),
    *("target_extents", "hidden_share", "_cleared_at_reset", "_obstacles", "_surface_points", "_radii", "_kinds"),
    *("_elapsed_steps", "_push_point", "_measure_now", "_just_reset"),
)


def repeated(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.repeat(ENVS, *[1] * (tensor.ndim - 1))


def several(env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let an environment take itself for several alike on a GPU; there is nothing but tensors from here on."""
    for name in PER_ENV:
        if hasattr(env, name):
            setattr(env, name, repeated(getattr(env, name)))
    env.num_envs, reached = ENVS, env.success_check.reached
    env.success_check = success.SuccessCheck(env, env.STAGES)
    env.success_check.restore(reached.T.repeat(ENVS, 1), slice(None))
    if env.dense_reward.last_action is not None:
        env.dense_reward.last_action = env.dense_reward.last_action.repeat(ENVS, 1)
    env._measured = None
    bodies, state = env.bodies, env.bodies.read().repeat(ENVS, 1)
    env.bodies = SimpleNamespace(others=None, read=lambda: state, objects=bodies.objects, basket=bodies.basket)
    forces = torch.from_numpy(env.gripper_contacts.forces())
    env.gripper_contacts = SimpleNamespace(forces=lambda still=None: repeated(forces))
    for module in (base, dense, goals, observations, success, search, open_pick, tasks.select):
        if hasattr(module, "native"):
            monkeypatch.setattr(module, "native", lambda tensor: tensor)
        if hasattr(module, "link_poses"):
            one = module.link_poses
            monkeypatch.setattr(module, "link_poses", lambda scene, links, one=one: repeated(one(scene, links)))
    if hasattr(env, "opening_position"):
        position = env.opening_position()
        env.opening_position = lambda: repeated(position)


@pytest.mark.parametrize("name", sorted(TASKS))
def test_several_envs_alike_are_found_alike(name, monkeypatch):
    made = gym.make(
        TASKS[name].env_id,
        obs_mode="state_dict",
        reward_mode="normalized_dense",
        control_mode="pd_joint_pos",
        render_backend="none",
    )
    made.reset(seed=0)
    env: Any = made.unwrapped
    rest = np.append(env.agent.robot.get_qpos()[0, 3:10].numpy(), 1.0).astype(np.float32)
    for _ in range(4):
        _, reward, *_, info = made.step(rest)
    told = env.privileged_observations()
    several(env, monkeypatch)
    found = env.get_info()
    rewards = env.get_reward({}, torch.as_tensor(rest).repeat(ENVS, 1), found)
    torch.testing.assert_close(rewards, repeated(reward), atol=1e-5, rtol=0)
    compared = set()
    for key, value in info.items():
        if isinstance(value, torch.Tensor) and key != "elapsed_steps":
            assert torch.equal(found[key], repeated(value)), key
            compared.add(key)
    assert {*env.STAGES, "success", "fail", "disturbed"} <= compared
    for key, value in env.privileged_observations().items():
        torch.testing.assert_close(value, repeated(told[key]), atol=1e-5, rtol=0, msg=key)
    made.close()
