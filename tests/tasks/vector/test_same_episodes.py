"""Episodes of an env do not depend on the other envs."""

from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest
import torch
from vector_envs import HORIZON, STATE_ONLY, make_actions, make_short_vec

import robocas_ms3
from robocas_ms3.core.errors import VectorEnvError
from robocas_ms3.tasks.vector import RoboCASVectorEnv

slow = pytest.mark.slow


def draw_actions(seed: int, steps: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 8)).astype(np.float32)


def record_episodes(env, num_envs: int, first_seed: int, steps: int) -> list[list[bytes]]:
    """Run random actions; return all observations and the last instruction of each env."""
    actions = np.stack([draw_actions(first_seed + i, steps) for i in range(num_envs)], 1)
    obs, _ = env.reset(seed=first_seed)
    seen = [[row.numpy().tobytes()] for row in obs]
    for action in actions:
        obs, *_, info = env.step(action)
        for i, row in enumerate(obs):
            last = info["final_obs"][i] if "final_info" in info and info["_final_info"][i] else row
            seen[i] += [last.numpy().tobytes(), row.numpy().tobytes()]
    for i, said in enumerate(env.unwrapped.get_language_instruction()):
        seen[i].append(said.encode())
    return seen


@pytest.fixture(scope="module")
def four_envs():
    env = make_short_vec(4, 2)
    yield env
    env.close()


@slow
def test_env_does_not_depend_on_other_envs(four_envs):
    steps = 2 * HORIZON + 2
    seen = record_episodes(four_envs, 4, 10, steps)
    with closing(make_short_vec(2, 1)) as two, closing(make_short_vec(1, 1)) as one:
        unseeded = two.reset()[0]
        assert torch.equal(one.reset()[0], unseeded[:1])
        assert not torch.equal(unseeded[1], unseeded[0])
        assert record_episodes(two, 2, 10, steps) == seen[:2]
        assert record_episodes(one, 1, 12, steps) == seen[2:3]
    with closing(make_short_vec(4, 1)) as in_one_process:
        assert record_episodes(in_one_process, 4, 10, steps) == seen
    assert len({b"".join(env) for env in seen}) == 4


@slow
def test_envs_in_this_process_give_the_same_results(four_envs):
    with closing(make_short_vec(2, 0)) as env:
        assert env.unwrapped.pids == ()
        assert record_episodes(env, 2, 20, HORIZON + 2) == record_episodes(four_envs, 4, 20, HORIZON + 2)[:2]


@slow
def test_env_gives_the_results_of_gym_make(four_envs):
    steps = HORIZON + 2
    seen = record_episodes(four_envs, 4, 20, steps)[3]
    env = gym.make("RoboCASPick-v1", max_episode_steps=HORIZON, **STATE_ONLY)
    obs, _ = env.reset(seed=23)
    plain = [obs[0].numpy().tobytes()]
    for action in draw_actions(23, steps):
        obs, _, _, truncated, _ = env.step(action)
        plain.append(obs[0].numpy().tobytes())
        if truncated:
            obs, _ = env.reset()
        plain.append(obs[0].numpy().tobytes())
    assert [*plain, env.unwrapped.get_language_instruction()[0].encode()] == seen
    env.close()


@slow
def test_partial_reset_does_not_change_the_other_envs(four_envs):
    first, _ = four_envs.reset(seed=[50, 51, 52, 53])
    once, *_ = four_envs.step(make_actions(1, 1, 1, 1))
    twice, *_ = four_envs.step(make_actions(1, 1, 1, 1))
    obs, info = four_envs.reset(seed=[50], options={"env_idx": torch.tensor([2])})
    assert info["elapsed_steps"].tolist() == [2, 2, 0, 2]
    assert torch.equal(obs[[0, 1, 3]], twice[[0, 1, 3]])
    assert torch.equal(obs[2], first[0])
    obs, *_ = four_envs.step(make_actions(1, 1, 1, 1))
    assert torch.equal(obs[2], once[0])
    four_envs.reset(seed=[50, 51, 52, 53])
    for _ in range(3):
        undisturbed, *_ = four_envs.step(make_actions(1, 1, 1, 1))
    assert torch.equal(obs[[0, 1, 3]], undisturbed[[0, 1, 3]])
    assert torch.equal(
        four_envs.reset(seed=50, options={"env_idx": [3, 1]})[0][3], first[0]
    )  # 50 for env 3, 51 for env 1
    assert torch.equal(four_envs.reset(options={"env_idx": np.array([False] * 4)})[0][1], first[1])
    for wrong in ({"env_idx": [0, 4]}, {"env_idx": [1, 1]}, {"env_idx": 1}):
        with pytest.raises(VectorEnvError, match="env_idx"):
            four_envs.reset(options=wrong)
    with pytest.raises(VectorEnvError, match="expected 4.*found 2"):
        four_envs.reset(seed=[1, 2])
    with pytest.raises(VectorEnvError, match=r"\(4, 8\).*\(4, 7\)"):
        four_envs.step(np.zeros((4, 7)))


@slow
def test_envs_that_keep_their_objects_have_the_objects_of_gym_make():
    kwargs = {"reconfiguration_freq": 0, "seeds": (100, 199), **STATE_ONLY}
    plain = gym.make("RoboCASPick-v1", **kwargs)
    short = {"max_episode_steps": 1, **kwargs}
    with closing(robocas_ms3.make_vec("RoboCASPick-v1", 2, backend="processes", workers=1, **short)) as env:
        assert isinstance(env, RoboCASVectorEnv)
        assert env.num_envs == 2
        unseeded, seeded = env.reset()[0], env.reset(seed=[5, 5])[0]
        *_, truncated, _ = env.step(make_actions(0, 0))
        assert truncated.tolist() == [True, True]
    assert torch.equal(unseeded[0], plain.reset()[0][0])
    assert torch.equal(seeded[0], plain.reset(seed=5)[0][0])
    plain.reset(seed=123, options={"reconfigure": True})  # 2023, within the range
    assert torch.equal(seeded[1], plain.reset(seed=5)[0][0])
    plain.close()


@slow
def test_images(needs_renderer):
    small = {"obs_mode": "rgb", "render_backend": "cpu", "sensor_configs": {"width": 32, "height": 24}}
    with closing(make_short_vec(2, 1, **small)) as env:
        obs, _ = env.reset(seed=0)
        image = obs["sensor_data"]["static_camera"]["rgb"]
        assert (image.shape, image.dtype) == ((2, 24, 32, 3), torch.uint8)
        plain = gym.make("RoboCASPick-v1", **{**STATE_ONLY, **small})
        for seed in (0, 1):
            alone = plain.reset(seed=seed)[0]["sensor_data"]["static_camera"]["rgb"][0]
            assert torch.equal(image[seed], alone)
        plain.close()
