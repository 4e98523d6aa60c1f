"""`make_vec` without simulation: backends, arguments, and conventions on a fake batch."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from vector_envs import STATE_ONLY, set_gpu_available

import robocas_ms3
from robocas_ms3.core.errors import VectorEnvError
from robocas_ms3.tasks.vector import RoboCASVectorEnv, choose_backend
from robocas_ms3.tasks.vector.worker import join_rows, split_rows


@pytest.mark.parametrize(
    ("backend", "sim_backend", "gpu", "chosen"),
    [
        ("auto", "auto", True, "gpu"),
        ("auto", "auto", False, "processes"),
        ("auto", "cpu", True, "processes"),
        ("auto", "physx_cuda", True, "gpu"),
        ("processes", "auto", True, "processes"),
        ("gpu", "cuda:1", True, "gpu"),
    ],
)
def test_backend_depends_on_arguments_and_devices(monkeypatch, backend, sim_backend, gpu, chosen):
    set_gpu_available(monkeypatch, gpu)
    assert choose_backend(backend, sim_backend) == chosen


@pytest.mark.parametrize(
    ("backend", "sim_backend", "gpu"),
    [
        ("gpu", "auto", False),
        ("auto", "physx_cuda", False),
        ("gpu", "physx_cpu", True),
        ("processes", "physx_cuda", True),
        ("threads", "auto", True),
    ],
)
def test_invalid_backend(monkeypatch, backend, sim_backend, gpu):
    set_gpu_available(monkeypatch, gpu)
    with pytest.raises(VectorEnvError):
        choose_backend(backend, sim_backend)


@pytest.mark.parametrize(
    "arguments",
    [
        {"env_id": "RoboCASPik-v1"},
        {"env_id": "nowhere_at_all:RoboCASPick-v1"},
        {"env_id": "CartPole-v1"},
        {"num_envs": 0},
        {"num_envs": 2.0},
        {"workers": -1},
        {"arrays": "jax"},
    ],
)
def test_invalid_arguments(arguments):
    with pytest.raises(VectorEnvError):
        robocas_ms3.make_vec(**{"env_id": "RoboCASPick-v1", "num_envs": 2, **arguments}, **STATE_ONLY)


@pytest.mark.parametrize("arguments", [{}, {"sim_backend": "physx_cpu"}])
def test_several_envs_in_one_process_on_a_cpu_point_to_make_vec(monkeypatch, arguments):
    set_gpu_available(monkeypatch, bool(arguments))
    with pytest.raises(VectorEnvError, match=r"num_envs=4.*robocas_ms3\.make_vec"):
        gym.make("RoboCASPick-v1", num_envs=4, **STATE_ONLY, **arguments)


class FakeBatch(gym.Env):
    """Fake batch of three envs: env i succeeds only at step i + 2, and each episode has four steps."""

    reconfiguration_freq, device, spec = 0, torch.device("cpu"), None
    single_action_space = gym.spaces.Box(-1, 1, (2,))
    single_observation_space = gym.spaces.Box(0, 9, (1,))
    action_space, observation_space = gym.spaces.Box(-1, 1, (3, 2)), gym.spaces.Box(0, 9, (3, 1))

    def __init__(self) -> None:
        self.metadata, self.num_envs = {}, 3
        self.elapsed_steps = torch.zeros(3, dtype=torch.int32)

    def reset(self, *, seed=None, options=None):
        self.elapsed_steps[options["env_idx"] if options else slice(None)] = 0
        return self.elapsed_steps[:, None].float(), {"elapsed_steps": self.elapsed_steps.clone()}

    def step(self, action):
        self.elapsed_steps += 1
        won = self.elapsed_steps == torch.arange(3) + 2
        info = {"success": won, "elapsed_steps": self.elapsed_steps.clone()}
        ended = self.elapsed_steps >= 4
        return self.elapsed_steps[:, None].float(), won.float(), won.clone(), ended, info


def test_success_once_and_at_end_of_an_episode():
    env = RoboCASVectorEnv(FakeBatch(), ignore_terminations=True, record_metrics=True)
    env.reset()
    for _ in range(3):
        *_, info = env.step(None)
        assert "final_info" not in info
    assert info["episode"]["success_at_end"].tolist() == [False, True, False]
    obs, _, terminated, truncated, info = env.step(None)
    episode = info["final_info"]["episode"]
    assert episode["success_once"].tolist() == [True, True, True]
    assert episode["success_at_end"].tolist() == [False, False, True]
    assert (obs.tolist(), info["final_obs"].tolist()) == ([[0.0]] * 3, [[4.0]] * 3)
    assert not terminated.any() and truncated.all()


def test_an_episode_that_ends_with_success_succeeded_at_its_end():
    env = RoboCASVectorEnv(FakeBatch(), record_metrics=True)
    env.reset()
    env.step(None)
    *_, info = env.step(None)
    assert info["_final_info"].tolist() == [True, False, False]
    assert info["final_info"]["episode"]["success_at_end"].tolist() == [True, False, False]


@pytest.mark.parametrize("other", [np.full((1, 2), 0.1), np.ones((1, 4), np.float32), ["text"], None])
def test_rows_of_different_types_become_a_list(other):
    zeros = np.zeros((2, 2), np.float32)
    rows = join_rows([(2, {("x",): zeros}), (1, {} if other is None else {("x",): other})])
    first, second, last = rows["x",]
    assert np.array_equal(last, other) if isinstance(other, np.ndarray) else last == (other or [None])[0]
    for row in (first, second):
        assert row.dtype == np.float32 and row.tolist() == [[0, 0]] and not np.shares_memory(row, zeros)


def test_rows_of_equal_shapes_become_an_array():
    ones = [{("x",): np.full((1, 2), i)} for i in range(3)]
    joined = join_rows([(1, row) for row in ones])
    assert joined["x",].tolist() == [[0, 0], [1, 1], [2, 2]]
    assert [row["x",].tolist() for row in split_rows(3, joined)] == [[[0, 0]], [[1, 1]], [[2, 2]]]


def test_call_finds_methods_behind_wrappers():
    env = RoboCASVectorEnv(gym.Wrapper(FakeBatch()))
    env.reset()
    assert env.call("elapsed_steps").tolist() == [0, 0, 0]
    assert len(env.call("step", None)) == 5
