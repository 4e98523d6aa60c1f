"""Seeds of episodes, layouts and appearance.

Batches are fake, because the simulator has only one env on a CPU.
"""

from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from several_envs import FakeLayout, make_batch_env

from robocas_ms3 import tasks
from robocas_ms3.core.errors import ConfigError, LayoutError, RobocasError
from robocas_ms3.scenes import cache
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.tasks.base import RoboCASEnv
from robocas_ms3.tasks.seeds import SEVERAL_ENVS_SEEDS, EpisodeSeeds

STATE_ONLY = {"render_backend": "none", "control_mode": "pd_joint_pos", "obs_mode": "none"}


class FakeBatchEnv(RoboCASEnv):
    """Fake batch of four envs that has only seeds."""

    device = torch.device("cpu")

    def __init__(self, seed_range=None) -> None:
        self.num_envs, self._enhanced_determinism, self._batched_rng_backend = 4, False, "numpy:random_state"
        self._episode_seed, self._batched_episode_rng = None, None
        self.seeds = EpisodeSeeds(4, Mock(), seed_range=seed_range, objects_stay=True)
        self.seeds.first_reset = False

    def seed(self, seeds, envs=(0, 1, 2, 3)) -> None:
        self._set_episode_rng(self.seeds.start_reset(seeds, list(envs)), torch.tensor(envs))


def read_generator_states(env: FakeBatchEnv) -> list[tuple]:
    rng = env._batched_episode_rng
    assert isinstance(rng, BatchedRNG)
    return [tuple(one.get_state()[1]) + (one.get_state()[2],) for one in rng.rngs]


@pytest.mark.parametrize("seeds", [[20, 21], None])
def test_partial_reset_does_not_change_other_envs(seeds):
    env = FakeBatchEnv()
    env.seed([7, 8, 9, 10])
    assert env.seeds.layout_seeds.tolist() == [7, 8, 9, 10]
    before, layouts = read_generator_states(env), env.seeds.layout_seeds.copy()
    env.seed(seeds, envs=(1, 3))
    after = read_generator_states(env)
    for other in (0, 2):
        assert after[other] == before[other]
        assert env.seeds.layout_seeds[other] == layouts[other]
        assert env._episode_seed[other] == layouts[other]
    for reset in (1, 3):
        assert after[reset] != before[reset]
        assert env.seeds.layout_seeds[reset] != layouts[reset]
    if seeds:
        assert env.seeds.layout_seeds[[1, 3]].tolist() == seeds


def test_unseeded_resets_draw_from_the_given_range():
    env = FakeBatchEnv(seed_range=(100, 109))
    env.seed([7, 8, 9, 10])  # requested seeds are used unchanged
    assert env.seeds.layout_seeds.tolist() == [7, 8, 9, 10]
    seen = set()
    for _ in range(30):
        env.seed(None)
        seen |= set(env.seeds.layout_seeds.tolist())
    assert seen == set(range(100, 110))


def test_an_unseeded_reset_of_one_env_draws_its_episode_seed_from_the_range():
    env = gym.make("RoboCASPick-v1", seeds=(3, 4), **STATE_ONLY)
    env.reset(seed=11, options={"env_idx": np.array([0])})  # as ManiSkill's wrapper for Stable-Baselines3 does
    assert env.unwrapped._episode_seed.tolist() == [11]
    seen = set()
    for _ in range(8):
        env.reset()
        assert env.unwrapped._episode_seed.tolist() == env.unwrapped.seeds.layout_seeds.tolist()
        seen |= set(env.unwrapped._episode_seed.tolist())
    assert seen == {3, 4}
    env.close()


def test_single_seed_of_several_envs_is_continued_within_the_range(monkeypatch):
    monkeypatch.setattr(tasks.scene_env, "make_layout_source", lambda model, folder: FakeLayout)
    env, asked = make_batch_env(None, monkeypatch, seeds=(10, 13))
    env.reset(seed=12)
    assert [seed for _, seed in asked[-1]] == [12, 13, 10, 11]
    env.reset(seed=500)
    assert [seed for _, seed in asked[-1]] == [500, 501, 502, 503]
    env.reset(seed=13, options={"env_idx": torch.tensor([1, 3])})
    assert [seed for _, seed in asked[-1]] == [13, 10]
    env.reset(seed=[4, 3, 2, 1])
    assert [seed for _, seed in asked[-1]] == [4, 3, 2, 1]


def test_only_a_requested_seed_must_have_a_layout(monkeypatch):
    def layouts(objects, seed):
        if seed in (2, 11):
            raise LayoutError("none", where="layout")
        return FakeLayout(objects, seed)

    monkeypatch.setattr(tasks.scene_env, "make_layout_source", lambda model, folder: layouts)
    env, asked = make_batch_env(None, monkeypatch, seeds=(10, 13))
    env.reset(seed=10)
    drawn = [seed for _, seed in asked[-1]]
    assert drawn[0] == 10
    assert drawn[1] in (10, 12, 13)
    with pytest.raises(LayoutError):
        env.reset(seed=11)
    with pytest.raises(LayoutError):
        env.reset(seed=[1, 2, 3, 4])


def test_invalid_arguments():
    with pytest.raises(ConfigError, match="invalid range of seeds"):
        gym.make("RoboCASPick-v1", seeds=(4, 3), **STATE_ONLY)
    env = gym.make("RoboCASPick-v1", **STATE_ONLY)
    with pytest.raises(RobocasError, match="reset_to_env_states.*set_state_dict"):
        env.reset(options={"reset_to_env_states": {}})
    env.close()


def test_several_envs_have_a_default_range_of_seeds(monkeypatch):
    low, high = SEVERAL_ENVS_SEEDS
    monkeypatch.setattr(tasks.scene_env, "make_layout_source", lambda model, folder: FakeLayout)
    env, asked = make_batch_env(None, monkeypatch, num_envs=high - low + 3)
    assert asked[0] == [(i, i) for i in [*range(low, high + 1), low, low + 1]]
    assert env.seeds.object_ids[0] == env.seeds.object_ids[high - low + 1] != env.seeds.object_ids[1]
    env.reset()
    assert all(low <= seed <= high for _, seed in asked[-1])
    env.reset(list(range(1000, 1000 + env.num_envs)))
    assert asked[-1][5] == (5, 1005)


def make_source_without(*pairs):
    """Return a layout source without layouts for ``pairs``, and the list of the requested pairs."""
    asked = []

    def source(objects, seed):
        asked.append((objects, seed))
        if (objects, seed) in pairs:
            raise LayoutError("no object qualifies as the target")
        return FakeLayout(objects, seed)

    return source, asked


def test_unseeded_reset_draws_until_a_seed_has_a_layout(monkeypatch, caplog):
    bad = [(objects, seed) for objects in (1, 2) for seed in range(100) if seed % 2 and seed != objects]
    source, asked = make_source_without(*bad)
    monkeypatch.setattr(tasks.scene_env, "make_layout_source", lambda model, folder: source)
    env, chosen = make_batch_env(None, monkeypatch)
    for _ in range(30):
        env.reset()
    assert not set(bad) & {pair for one in chosen for pair in one}
    assert {objects for one in chosen for objects, _ in one} == {0, 1, 2, 3}  # objects stay the same
    failed = set(bad) & set(asked)
    assert failed
    assert all(asked.count(pair) == 1 for pair in failed)
    assert "env 1: no layout for seed" in caplog.text
    with pytest.raises(LayoutError, match="no object qualifies"):  # a requested seed: an error
        env.reset([0, 1, 3, 3])


def test_configuration_without_layouts_fails_early(monkeypatch):
    source, asked = make_source_without(*((seed, seed) for seed in range(100)))
    monkeypatch.setattr(tasks.scene_env, "make_layout_source", lambda model, folder: source)
    with pytest.raises(LayoutError, match="no object qualifies"):
        make_batch_env(None, monkeypatch)
    assert len(asked) <= 3


def test_one_env_replaces_a_seed_without_layout_unless_requested(monkeypatch, caplog):
    sample, failed = cache.sample_layout, []

    def sample_or_fail(model, objects, seed, object_ids):
        if len(failed) < 2 or seed == 5:
            failed.append(seed)
            raise LayoutError("no object qualifies as the target")
        return sample(model, objects, seed)

    monkeypatch.setattr(cache, "sample_layout", sample_or_fail)
    env = gym.make("RoboCASPick-v1", layouts=None, **STATE_ONLY)
    assert failed[0] == 2022 and "drawing another seed" in caplog.text
    failed.clear()
    env.reset()
    base = env.unwrapped
    assert len(failed) == 2 and base._episode_seed[0] not in failed
    assert base._episode_seed[0] == base.seeds.objects_seeds[0] == base.seeds.layout_seeds[0]
    with pytest.raises(LayoutError):
        env.reset(seed=5)
    env.reset(seed=6)
    env.close()


def test_failed_reset_does_not_change_a_single_env(monkeypatch):
    env = gym.make("RoboCASPick-v1", **STATE_ONLY)
    base = env.unwrapped
    env.reset(seed=3)
    before, said, state = base.layout().object_poses, base.get_language_instruction(), env.unwrapped.get_state()
    monkeypatch.setattr(base.seeds, "layouts", Mock(side_effect=LayoutError("no object qualifies as the target")))
    with pytest.raises(LayoutError):
        env.reset(seed=5)
    assert base.seeds.layout_seeds.tolist() == [3]
    np.testing.assert_array_equal(base.layout().object_poses, before)
    assert base.get_language_instruction() == said
    assert torch.equal(base.get_state(), state)
    env.close()


@pytest.mark.slow
def test_appearance_depends_on_the_seed_and_does_not_change_the_layout(needs_renderer):
    data = load_task_config("pick_table_scattered").model_dump(mode="json")
    blocks = {"room": ["wall", "floor"], "lights": {}, "cameras": {}}

    def render_and_read_poses(randomisation, seed):
        env = gym.make("RoboCASPick-v1", config={**data, "randomisation": randomisation}, obs_mode="rgb")
        obs, _ = env.reset(seed=seed)
        poses = env.unwrapped.object_poses
        env.close()
        return obs["sensor_data"]["static_camera"]["rgb"].float(), poses

    plain, random, again = (
        render_and_read_poses({}, 3),
        render_and_read_poses(blocks, 3),
        render_and_read_poses(blocks, 3),
    )
    assert torch.equal(plain[1], random[1])
    assert (plain[0] - random[0]).abs().mean() > 5
    assert torch.equal(random[0], again[0])
