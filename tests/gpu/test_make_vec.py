"""`make_vec` with its GPU backend: automatic resets, NumPy arrays, resets of some envs, synchronisation per step."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from gpu_emulation import emulated_envs
from gymnasium.vector import VectorEnv
from synchronisation import count_host_synchronisations

import robocas_ms3
from robocas_ms3.tasks import TASKS
from robocas_ms3.tasks.vector import RoboCASVectorEnv

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: unproven on a GPU"),
]

ENVS = emulated_envs() or 16
LIMIT = 4  # steps per episode
SOME = [1, 3]
OTHERS = [i for i in range(ENVS) if i not in SOME]


def make(task: str, **kwargs: Any) -> VectorEnv:
    settings = dict(obs_mode="state", render_backend="none", max_episode_steps=LIMIT)
    return robocas_ms3.make_vec(TASKS[task].env_id, ENVS, backend="gpu", **{**settings, **kwargs})


@pytest.fixture(scope="module", params=["pick", "search"])
def envs(request: pytest.FixtureRequest) -> Iterator[VectorEnv]:
    made = make(request.param)
    yield made
    made.close()


def hold_still(envs: VectorEnv) -> torch.Tensor:
    """Return actions (N, 8) that hold the arm in place with an open gripper."""
    base: Any = envs.unwrapped
    return torch.cat([base.agent.robot.get_qpos()[:, 3:10], torch.ones(ENVS, 1, device=base.device)], dim=1)


def test_ended_envs_are_reset_in_the_same_step(envs):
    assert isinstance(envs, RoboCASVectorEnv)
    observation, _ = envs.reset(seed=0)
    assert observation.shape == envs.observation_space.shape and observation.is_cuda
    for step in range(1, LIMIT + 1):
        observation, reward, terminated, truncated, info = envs.step(hold_still(envs))
        assert ("final_info" in info) == (step == LIMIT)
        for value in (observation, reward, terminated, truncated):
            assert value.is_cuda and len(value) == ENVS
    assert truncated.all() and info["_final_info"].all()
    assert not torch.equal(info["final_obs"], observation)
    assert info["elapsed_steps"].tolist() == [0] * ENVS
    episode = info["final_info"]["episode"]
    assert episode["episode_len"].tolist() == [LIMIT] * ENVS
    assert not episode["success_once"].any() and not episode["success_at_end"].any()
    torch.testing.assert_close(episode["return"], LIMIT * episode["reward"])
    *_, info = envs.step(hold_still(envs))
    assert info["elapsed_steps"].tolist() == info["episode"]["episode_len"].tolist() == [1] * ENVS


def test_partial_reset_keeps_other_envs_and_their_metrics(envs):
    base: Any = envs.unwrapped
    envs.reset(seed=0)
    for _ in range(2):
        observation, *_, info = envs.step(hold_still(envs))
    before, returns = base.object_poses.clone(), info["episode"]["return"].clone()
    index = torch.tensor(SOME, device=base.device)
    again, info = envs.reset(seed=[7, 8], options={"env_idx": index})
    assert info["elapsed_steps"].tolist() == [0 if i in SOME else 2 for i in range(ENVS)]
    torch.testing.assert_close(base.object_poses[OTHERS], before[OTHERS], atol=1e-5, rtol=0)
    assert not torch.equal(base.object_poses[SOME], before[SOME])
    torch.testing.assert_close(again[OTHERS], observation[OTHERS], atol=1e-5, rtol=0)
    _, reward, *_, info = envs.step(hold_still(envs))
    expected = reward + torch.where(info["elapsed_steps"] == 1, 0, returns)
    torch.testing.assert_close(info["episode"]["return"], expected)
    *_, truncated, info = envs.step(hold_still(envs))
    assert truncated.tolist() == info["_final_info"].tolist() == [i not in SOME for i in range(ENVS)]
    assert info["elapsed_steps"].tolist() == [2 if i in SOME else 0 for i in range(ENVS)]


def test_step_synchronises_once(envs):
    """`ManiSkillVectorEnv` reads whether any env has ended."""
    envs.reset(seed=0)
    action = hold_still(envs)
    envs.step(action)  # fills caches
    with count_host_synchronisations() as counted:
        envs.step(action)
    assert sum(counted.values()) == 1, counted


def test_numpy_arrays():
    envs = make("pick", arrays="numpy")
    observation, _ = envs.reset(seed=0)
    assert isinstance(observation, np.ndarray) and observation.dtype == np.float32
    for _ in range(LIMIT):
        action = envs.action_space.sample()
        observation, reward, terminated, truncated, info = envs.step(action)
        for value in (observation, reward, terminated, truncated, info["success"]):
            assert isinstance(value, np.ndarray) and len(value) == ENVS
    assert isinstance(info["final_obs"], np.ndarray)
    assert isinstance(info["final_info"]["episode"]["return"], np.ndarray)
    observation, info = envs.reset(options={"env_idx": np.array(SOME)})
    assert isinstance(observation, np.ndarray) and isinstance(info["elapsed_steps"], np.ndarray)
    envs.close()
