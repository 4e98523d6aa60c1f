"""`make_vec` without simulation: backend, arguments, and conventions on a batch that counts its steps."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from vector_envs import STATE_ONLY, with_gpu

import robocas_ms3
from robocas_ms3.core.errors import VectorEnvError
from robocas_ms3.tasks.vector import RoboCASVectorEnv, choose_backend
from robocas_ms3.tasks.vector.worker import join_rows, replace_rows


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
def test_the_backend_follows_from_what_is_asked_and_what_is_there(monkeypatch, backend, sim_backend, gpu, chosen):
    with_gpu(monkeypatch, gpu)
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
    with_gpu(monkeypatch, gpu)
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
        {"workers": 0},
        {"arrays": "jax"},
    ],
)
def test_invalid_arguments(arguments):
    with pytest.raises(VectorEnvError):
        robocas_ms3.make_vec(**{"env_id": "RoboCASPick-v1", "num_envs": 2, **arguments}, **STATE_ONLY)


@pytest.mark.parametrize("arguments", [{}, {"sim_backend": "physx_cpu"}])
def test_several_envs_in_one_process_on_a_cpu_point_to_make_vec(monkeypatch, arguments):
    with_gpu(monkeypatch, bool(arguments))
    with pytest.raises(VectorEnvError, match=r"num_envs=4.*robocas_ms3\.make_vec"):
        gym.make("RoboCASPick-v1", num_envs=4, **STATE_ONLY, **arguments)


class FakeBatch(gym.Env):
    """Three envs that count their steps: env i succeeds at step i + 2 alone, and every fourth step is the last."""

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


def test_new_rows_of_some_envs_take_the_place_of_old_ones_of_any_kind():
    old = np.zeros((3, 2), np.float32)
    assert replace_rows(old, [1], np.ones((1, 2), np.float32)) is old and old.tolist() == [[0, 0], [1, 1], [0, 0]]
    for other in (np.full((1, 2), 0.1), np.ones((1, 4), np.float32), ["text"]):  # another type, shape, no array
        first, new, last = replace_rows(np.zeros((3, 2), np.float32), [1], other)
        assert new is other[0] or np.array_equal(new, other)
        assert first.dtype == last.dtype == np.float32
    rows = replace_rows([None, None], [0, 1], np.ones((2, 4)))
    assert isinstance(rows, np.ndarray) and rows.shape == (2, 4)


def test_rows_that_were_returned_do_not_change_in_a_later_reset():
    last = np.zeros((2, 1), np.float32)
    (returned,) = join_rows([(2, {("x",): last}), (1, {})]).values()  # the third env has none
    replace_rows(last, [0], np.ones((1, 1), np.float32))
    assert returned[0].tolist() == [[0]] and returned[2] is None


def test_calls_reach_through_wrappers():
    env = RoboCASVectorEnv(gym.Wrapper(FakeBatch()))
    env.reset()
    assert env.call("elapsed_steps").tolist() == [0, 0, 0]
    assert len(env.call("step", None)) == 5
