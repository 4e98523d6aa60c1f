"""Seeds of episodes, layouts and looks. Several envs are tested without a simulator, which on a CPU has but one env."""

import shutil
from dataclasses import fields
from typing import Any, NamedTuple
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG

from robocas_ms3 import tasks
from robocas_ms3.cli.layouts import Build, Layouts, main
from robocas_ms3.config import load_task_config
from robocas_ms3.errors import ConfigError, LayoutError, RobocasError
from robocas_ms3.scenes import bank, source
from robocas_ms3.scenes.table import State
from robocas_ms3.tasks import RoboCASPickEnv
from robocas_ms3.tasks.seeds import SEVERAL_ENVS_SEEDS, SeededEnv
from robocas_ms3.tasks.starts import Starts

STATE_ONLY = {"render_backend": "none", "control_mode": "pd_joint_pos", "obs_mode": "none"}


class FourEnvs(SeededEnv):
    """Four envs' seeds and layouts, and nothing else of an environment."""

    def __init__(self, seed_range=None, layouts=None) -> None:
        self.num_envs, self._enhanced_determinism, self._batched_rng_backend = 4, False, "numpy:random_state"
        self._resets_seeded, self._seed_range, self._made = True, seed_range, True
        self._layouts, self._failed, self._other_seeds, self._found, self._own = layouts, {}, 2, {}, {}
        self._table = self._tabled = None
        self._layout_seeds, self._objects_seeds = np.zeros(4, dtype=np.int64), np.zeros(4, dtype=np.int64)
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


def several(folder, monkeypatch, num_envs=4, **arguments) -> tuple[RoboCASPickEnv, list]:
    """An environment of several envs, made as `gym.make` does, but for the simulator; and the layouts it asked for."""
    asked = []

    def resets(env, seed=None, options=None):
        index = torch.as_tensor((options or {}).get("env_idx", range(num_envs)))
        env._set_episode_rng(seed, index)
        if (options or {}).get("reconfigure"):
            env._choose_objects()
            env._set_episode_rng(env._episode_seed, index)
        env._found.clear()
        env.layouts = [env.layout(i) for i in index.tolist()]
        asked.append([(int(env._objects_seeds[i]), int(env._layout_seeds[i])) for i in index])
        return {}, {}

    def makes(env, *args, num_envs, **rest):
        env.num_envs, env._enhanced_determinism, env._batched_rng_backend = num_envs, False, "numpy:random_state"
        env._episode_seed, env._batched_episode_rng = None, None
        env.reset([2022 + i for i in range(num_envs)], {"reconfigure": True})  # as ManiSkill does

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(BaseEnv, "_sim_device", Mock(is_cuda=lambda: True), raising=False)
    monkeypatch.setattr(BaseEnv, "device", torch.device("cpu"), raising=False)
    monkeypatch.setattr(BaseEnv, "__init__", makes)
    monkeypatch.setattr(BaseEnv, "reset", resets)
    return RoboCASPickEnv(num_envs=num_envs, layouts=folder, **arguments), asked


class Thing(NamedTuple):
    """What stands for a layout."""

    objects: int
    seed: int

    @property
    def object_ids(self) -> tuple[str, ...]:
        return (f"thing {self.objects}",)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A bank's folder for objects of two seeds and layouts of three, with their table."""
    folder = tmp_path_factory.mktemp("banks")
    command = Build("pick_table_scattered", objects="0:2", seeds="0:3", jobs=1, out=folder, engine="cpu")
    assert main(Layouts(command)) == 0
    return folder


@pytest.fixture
def tabled(built, tmp_path, monkeypatch):
    """The same with the table of a GPU, which no GPU has tried, and nothing else: making or reading one would fail."""
    shutil.copytree(built, tmp_path, dirs_exist_ok=True)
    assert bank.count_layouts(next(tmp_path.iterdir())) == 6
    table = next(tmp_path.glob("*/table-cpu.npy"))
    table.rename(table.with_name("table-gpu.npy"))
    monkeypatch.setattr(source, "sample_layout", None)
    monkeypatch.setattr(bank, "read_layout", None)
    return tmp_path


def assert_same(one: Starts, two: Starts) -> None:
    for field in fields(Starts):
        torch.testing.assert_close(getattr(one, field.name), getattr(two, field.name), atol=1e-6, rtol=0)


def test_several_envs_reset_from_a_table_built_for_them(tabled, monkeypatch):
    env, asked = several(tabled, monkeypatch, seeds=(0, 1))
    everyone = np.arange(4)
    one_by_one = Starts.of([env.layout(i) for i in range(4)], "cpu")
    assert_same(env._find_starts(everyone), one_by_one)
    assert not env._found  # read when they are asked for
    assert asked == [[(0, 0), (1, 1), (0, 0), (1, 1)]]
    for _ in range(20):
        env.reset()
    assert {seed for one in asked for _, seed in one} == {0, 1}
    assert all([objects for objects, _ in one] == [0, 1, 0, 1] for one in asked)
    env.reset(options={"env_idx": torch.tensor([2])})
    assert [objects for objects, _ in asked[-1]] == [0]
    assert_same(env._find_starts(np.array([2])), Starts.of([env.layout(2)], "cpu"))
    assert env.layouts[0].object_ids == env._object_ids[2] == env._object_ids[0] != env._object_ids[1]


def test_what_moves_where_it_would_run_is_drawn_no_more_and_an_error_where_it_is_asked_for(tabled, monkeypatch):
    env, _ = several(tabled, monkeypatch, num_envs=2, seeds=(0, 2))
    layouts: Any = env._layouts
    layouts.mark_table("gpu", {(0, 1): State.MOVES, (1, 1): State.MOVES, (1, 2): State.STAYS})
    env, _ = several(tabled, monkeypatch, num_envs=2, seeds=(0, 2))
    assert env._objects_seeds.tolist() == [0, 1]  # env 1 keeps its objects, and begins with another layout of them
    for _ in range(20):
        env.reset()
        assert env._find_starts(np.arange(2)).targets.shape == (2,)
        assert 1 not in env._layout_seeds
    with pytest.raises(LayoutError, match="objects seed 0, seed 1: objects move as soon as this engine runs"):
        env.reset(seed=[1, 0])


def test_many_layouts_may_move_and_all_of_some_objects(tabled, monkeypatch, caplog):
    env, _ = several(tabled, monkeypatch, num_envs=2, seeds=(0, 2))
    layouts: Any = env._layouts
    layouts.mark_table("gpu", {pair: State.MOVES for pair in [(0, 0), (0, 2), (1, 0), (1, 1), (1, 2)]})
    for _ in range(10):
        env, _ = several(tabled, monkeypatch, num_envs=2, seeds=(0, 1))
        assert env._objects_seeds.tolist() == [0, 0]
        for _ in range(10):
            env._set_episode_rng(None, torch.tensor([0, 1]))
            assert env._find_starts(np.arange(2)).targets.shape == (2,)
            assert env._layout_seeds.tolist() == [1, 1]
    assert not [record for record in caplog.records if record.levelname == "WARNING"]


def test_a_reset_that_is_refused_leaves_the_envs_as_they_were(tabled, monkeypatch):
    env, _ = several(tabled, monkeypatch, num_envs=2, seeds=(0, 2))
    layouts: Any = env._layouts
    layouts.mark_table("gpu", {(0, 1): State.MOVES})
    env, _ = several(tabled, monkeypatch, num_envs=2, seeds=(0, 2))
    env.reset(seed=[2, 0])
    before = [env.layout(i).object_poses for i in range(2)]
    for _ in range(3):
        with pytest.raises(LayoutError):
            env.reset(seed=[1, 2])
    assert env._layout_seeds.tolist() == [2, 0]
    np.testing.assert_array_equal([env.layout(i).object_poses for i in range(2)], before)
    layouts.mark_table("gpu", {(0, 1): State.STAYS})
    env.reset(options={"reconfigure": True}, seed=[0, 1])
    env.reset(seed=[1, 2])  # nothing is remembered of what it was


def test_where_a_table_lacks_layouts_the_bank_makes_them(built, tmp_path, monkeypatch):
    shutil.copytree(built, tmp_path, dirs_exist_ok=True)
    table = next(tmp_path.glob("*/table-cpu.npy"))
    table.rename(table.with_name("table-gpu.npy"))
    env, _ = several(tmp_path, monkeypatch, num_envs=2, seeds=(0, 1))
    env.reset(seed=[1, 7])
    assert env._table is not None
    assert env._table.state((1, 7)) == State.LACKING
    found = env._find_starts(np.array([0, 1]))
    assert_same(found, Starts.of([env._layouts(0, 1), env._layouts(1, 7)], "cpu"))


def test_one_env_that_keeps_its_objects_resets_from_a_table(built, monkeypatch):
    monkeypatch.setattr(source, "sample_layout", None)
    made = gym.make("RoboCASPick-v1", layouts=built, reconfiguration_freq=0, seeds=(0, 2), **STATE_ONLY)
    env: Any = made.unwrapped
    assert env._tabled is not None
    monkeypatch.setattr(env._tabled, "gather", gather := Mock(wraps=env._tabled.gather))
    for seed in (2, 0):
        made.reset(seed=seed)
        wanted = bank.read_layout(env._layouts.path(env._objects_seeds[0], seed))
        torch.testing.assert_close(env.object_poses, Starts.of([wanted], "cpu").object_poses, atol=1e-6, rtol=0)
        assert int(env.target_slot) == wanted.target
    assert gather.call_count == 2
    made.close()


def test_one_seed_for_several_envs_is_the_first_ones_and_the_others_follow_within_the_range(monkeypatch):
    monkeypatch.setattr(tasks.scene, "layout_bank", lambda model, folder: Thing)
    env, asked = several(None, monkeypatch, seeds=(10, 13))
    env.reset(seed=12)
    assert [seed for _, seed in asked[-1]] == [12, 13, 10, 11]
    env.reset(seed=500)
    assert [seed for _, seed in asked[-1]] == [500, 501, 502, 503]
    env.reset(seed=13, options={"env_idx": torch.tensor([1, 3])})
    assert [seed for _, seed in asked[-1]] == [13, 10]
    env.reset(seed=[4, 3, 2, 1])
    assert [seed for _, seed in asked[-1]] == [4, 3, 2, 1]


def test_only_the_seed_that_was_asked_for_must_have_a_layout(monkeypatch):
    def layouts(objects, seed):
        if seed in (2, 11):
            raise LayoutError("none", where="layout")
        return Thing(objects, seed)

    monkeypatch.setattr(tasks.scene, "layout_bank", lambda model, folder: layouts)
    env, asked = several(None, monkeypatch, seeds=(10, 13))
    env.reset(seed=10)
    drawn = [seed for _, seed in asked[-1]]
    assert drawn[0] == 10
    assert drawn[1] in (10, 12, 13)
    with pytest.raises(LayoutError):
        env.reset(seed=11)
    with pytest.raises(LayoutError):
        env.reset(seed=[1, 2, 3, 4])


def test_states_are_no_way_to_reset():
    env = gym.make("RoboCASPick-v1", **STATE_ONLY)
    with pytest.raises(RobocasError, match="reset_to_env_states.*set_state_dict"):
        env.reset(options={"reset_to_env_states": {}})
    env.close()


def test_several_envs_draw_from_a_range_without_being_told_and_beyond_it_share_objects(monkeypatch):
    low, high = SEVERAL_ENVS_SEEDS
    monkeypatch.setattr(tasks.scene, "layout_bank", lambda model, folder: Thing)
    env, asked = several(None, monkeypatch, num_envs=high - low + 3)
    assert asked[0] == [(i, i) for i in [*range(low, high + 1), low, low + 1]]
    assert env._object_ids[0] == env._object_ids[high - low + 1] != env._object_ids[1]
    env.reset()
    assert all(low <= seed <= high for _, seed in asked[-1])
    env.reset(list(range(1000, 1000 + env.num_envs)))
    assert asked[-1][5] == (5, 1005)


def without(*pairs):
    """A source that has no layout for some pairs of seeds, and the pairs it was asked for."""
    asked = []

    def source(objects, seed):
        asked.append((objects, seed))
        if (objects, seed) in pairs:
            raise LayoutError("no object qualifies as the target")
        return Thing(objects, seed)

    return source, asked


def test_an_unseeded_reset_goes_on_to_a_seed_that_has_a_layout(monkeypatch, caplog):
    bad = [(objects, seed) for objects in (1, 2) for seed in range(100) if seed % 2 and seed != objects]
    source, asked = without(*bad)
    monkeypatch.setattr(tasks.scene, "layout_bank", lambda model, folder: source)
    env, chosen = several(None, monkeypatch)
    for _ in range(30):
        env.reset()
    assert not set(bad) & {pair for one in chosen for pair in one}
    assert {objects for one in chosen for objects, _ in one} == {0, 1, 2, 3}  # objects stay
    failed = set(bad) & set(asked)
    assert failed
    assert all(asked.count(pair) == 1 for pair in failed)
    assert "env 1: no layout for seed" in caplog.text
    with pytest.raises(LayoutError, match="no object qualifies"):  # asked for: an error
        env.reset([0, 1, 3, 3])


def test_that_there_is_no_layout_at_all_is_said_soon(monkeypatch):
    source, asked = without(*((seed, seed) for seed in range(100)))
    monkeypatch.setattr(tasks.scene, "layout_bank", lambda model, folder: source)
    with pytest.raises(LayoutError, match="no object qualifies"):
        several(None, monkeypatch)
    assert len(asked) <= 3


def test_one_env_starts_over_with_another_seed_unless_it_was_asked_for(monkeypatch, caplog):
    sample, failed = source.sample_layout, []

    def fussy(model, objects, seed, object_ids):
        if len(failed) < 2 or seed == 5:
            failed.append(seed)
            raise LayoutError("no object qualifies as the target")
        return sample(model, objects, seed)

    monkeypatch.setattr(source, "sample_layout", fussy)
    env = gym.make("RoboCASPick-v1", layouts=None, **STATE_ONLY)
    assert failed[0] == 2022 and "another is drawn" in caplog.text
    failed.clear()
    env.reset()
    base = env.unwrapped
    assert len(failed) == 2 and base._episode_seed[0] not in failed
    assert base._episode_seed[0] == base._objects_seeds[0] == base._layout_seeds[0]
    with pytest.raises(LayoutError):
        env.reset(seed=5)
    env.reset(seed=6)
    env.close()


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


def test_envs_to_reset_may_be_an_array_as_stable_baselines_wrapper_gives_it():
    env = gym.make("RoboCASPick-v1", **STATE_ONLY)
    env.reset(seed=3)
    before = env.unwrapped.get_state()
    env.reset(seed=5, options={"env_idx": np.array([0])})
    assert not torch.equal(before, env.unwrapped.get_state())
    env.close()
