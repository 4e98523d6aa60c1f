"""Seeds of episodes, layouts and looks. Several envs are tested without a simulator, which on a CPU has but one env."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG

import robocas_ms3  # noqa: F401
from robocas_ms3.config import load_task_config
from robocas_ms3.errors import ConfigError
from robocas_ms3.tasks.base import RoboCASEnv

STATE_ONLY = {"render_backend": "none", "control_mode": "pd_joint_pos", "obs_mode": "none"}


class FourEnvs(RoboCASEnv):
    """Four envs' seeds, and nothing else of an environment."""

    def __init__(self, seed_range=None) -> None:
        self.num_envs, self._enhanced_determinism, self._batched_rng_backend = 4, False, "numpy:random_state"
        self._resets_seeded, self._seed_range = True, seed_range
        self._layout_seeds = np.zeros(4, dtype=np.int64)
        self._episode_seed, self._batched_episode_rng = None, None

    def seed(self, seeds, envs=(0, 1, 2, 3)) -> None:
        self._resets_seeded = seeds is not None
        self._set_episode_rng(seeds, torch.tensor(envs))


def states(env: FourEnvs) -> list[tuple]:
    rng = env._batched_episode_rng
    assert isinstance(rng, BatchedRNG)
    return [tuple(one.get_state()[1]) + (one.get_state()[2],) for one in rng.rngs]


def test_every_env_has_the_layout_of_its_seed():
    env = FourEnvs()
    env.seed([7, 8, 9, 10])
    assert env._layout_seeds.tolist() == [7, 8, 9, 10]


@pytest.mark.parametrize("seeds", [[20, 21], None])
def test_a_partial_reset_leaves_the_other_envs_alone(seeds):
    env = FourEnvs()
    env.seed([7, 8, 9, 10])
    before, layouts = states(env), env._layout_seeds.copy()
    env.seed(seeds, envs=(1, 3))
    after = states(env)
    for other in (0, 2):
        assert after[other] == before[other]
        assert env._layout_seeds[other] == layouts[other]
        assert env._episode_seed[other] == layouts[other]
    for reset in (1, 3):
        assert after[reset] != before[reset]
        assert env._layout_seeds[reset] != layouts[reset]
    if seeds:
        assert env._layout_seeds[[1, 3]].tolist() == seeds


def test_unseeded_resets_draw_from_the_given_range():
    env = FourEnvs(seed_range=(100, 109))
    env.seed([7, 8, 9, 10])  # asked for: taken as they are
    assert env._layout_seeds.tolist() == [7, 8, 9, 10]
    seen = set()
    for _ in range(30):
        env.seed(None)
        seen |= set(env._layout_seeds.tolist())
    assert seen == set(range(100, 110))


def test_an_unseeded_reset_of_one_env_draws_its_episode_seed_from_the_range():
    env = gym.make("RoboCASPick-v1", seeds=(3, 4), **STATE_ONLY)
    env.reset(seed=11)
    assert env.unwrapped._episode_seed.tolist() == [11]
    seen = set()
    for _ in range(8):
        env.reset()
        assert env.unwrapped._episode_seed.tolist() == env.unwrapped._layout_seeds.tolist()
        seen |= set(env.unwrapped._episode_seed.tolist())
    assert seen == {3, 4}
    env.close()


def test_a_range_that_is_none():
    with pytest.raises(ConfigError, match="seeds are a range"):
        gym.make("RoboCASPick-v1", seeds=(4, 3), **STATE_ONLY)


@pytest.mark.slow
def test_looks_follow_the_seed_and_leave_the_layout(needs_renderer):
    data = load_task_config("pick_table_scattered").model_dump(mode="json")
    blocks = {"room": ["wall", "floor"], "lights": {}, "cameras": {}}

    def look(randomisation, seed):
        env = gym.make("RoboCASPick-v1", config={**data, "randomisation": randomisation}, obs_mode="rgb")
        obs, _ = env.reset(seed=seed)
        poses = env.unwrapped.object_poses
        env.close()
        return obs["sensor_data"]["static_camera"]["rgb"].float(), poses

    plain, random, again = look({}, 3), look(blocks, 3), look(blocks, 3)
    assert torch.equal(plain[1], random[1])
    assert (plain[0] - random[0]).abs().mean() > 5
    assert torch.equal(random[0], again[0])
