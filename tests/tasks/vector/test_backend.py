"""Which backend several environments at once run on, and what can not be asked for."""

import gymnasium as gym
import pytest
from vector_envs import STATE_ONLY, with_gpu

import robocas_ms3
from robocas_ms3.core.errors import VectorEnvError
from robocas_ms3.tasks.vector.backend import choose_backend


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
    ("backend", "sim_backend", "gpu", "words"),
    [
        ("gpu", "auto", False, ["no CUDA device", 'backend="processes"']),
        ("auto", "physx_cuda", False, ["no CUDA device"]),
        ("gpu", "physx_cpu", True, ["contradict", "physx_cpu"]),
        ("processes", "physx_cuda", True, ["contradict", "physx_cuda"]),
        ("threads", "auto", True, ["threads", "processes"]),
    ],
)
def test_a_backend_that_can_not_be_is_an_error(monkeypatch, backend, sim_backend, gpu, words):
    with_gpu(monkeypatch, gpu)
    with pytest.raises(VectorEnvError) as error:
        choose_backend(backend, sim_backend)
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"env_id": "RoboCASPik-v1"}, ["RoboCASPik-v1", "RoboCASPick-v1"]),
        ({"env_id": "nowhere_at_all:RoboCASPick-v1"}, ["nowhere_at_all"]),
        ({"env_id": "CartPole-v1"}, ["CartPole-v1", "RoboCASPick-v1"]),
        ({"num_envs": 0}, ["num_envs", "from 1 on", "0"]),
        ({"num_envs": 2.0}, ["num_envs", "2.0"]),
        ({"workers": 0}, ["workers"]),
        ({"arrays": "jax"}, ["jax", "numpy"]),
    ],
)
def test_wrong_arguments_are_one_line(arguments, words):
    with pytest.raises(VectorEnvError) as error:
        robocas_ms3.make_vec(**{"env_id": "RoboCASPick-v1", "num_envs": 2, **arguments}, **STATE_ONLY)
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize("arguments", [{}, {"sim_backend": "physx_cpu"}])
def test_several_envs_in_one_process_on_a_cpu_point_to_make_vec(monkeypatch, arguments):
    with_gpu(monkeypatch, bool(arguments))
    with pytest.raises(VectorEnvError, match=r"num_envs=4.*robocas_ms3\.make_vec"):
        gym.make("RoboCASPick-v1", num_envs=4, **STATE_ONLY, **arguments)
