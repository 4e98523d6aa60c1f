"""Resets from a layout table with statuses of layouts. No GPU."""

import shutil
from dataclasses import fields
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from several_envs import make_batch_env

from robocas_ms3.cli.layouts import Build, build
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.scenes import cache
from robocas_ms3.scenes.layout import read_layout
from robocas_ms3.scenes.layout_table import LayoutStatus
from robocas_ms3.tasks.initial_states import InitialStates

STATE_ONLY = {"render_backend": "none", "control_mode": "pd_joint_pos", "obs_mode": "none"}


@pytest.fixture(scope="module")
def cache_with_table(tmp_path_factory):
    """Return a cache folder with a layout table of two objects seeds and three layout seeds."""
    folder = tmp_path_factory.mktemp("layouts")
    command = Build("pick_table_scattered", objects="0:2", seeds="0:3", jobs=1, out=folder, engine="cpu")
    assert build(command) == 0
    return folder


@pytest.fixture
def cache_of_gpu_table(cache_with_table, tmp_path, monkeypatch):
    """Return a cache folder with an unchecked table of a GPU; only reading the table succeeds."""
    shutil.copytree(cache_with_table, tmp_path, dirs_exist_ok=True)
    assert cache.count_layouts(next(tmp_path.iterdir())) == 6
    table = next(tmp_path.glob("*/table-cpu.npy"))
    table.rename(table.with_name("table-gpu.npy"))
    monkeypatch.setattr(cache, "sample_layout", None)
    monkeypatch.setattr(cache, "read_layout", None)
    return tmp_path


def assert_equal_states(one: InitialStates, two: InitialStates) -> None:
    for field in fields(InitialStates):
        torch.testing.assert_close(getattr(one, field.name), getattr(two, field.name), atol=1e-6, rtol=0)


def test_several_envs_reset_from_a_table_built_for_them(cache_of_gpu_table, monkeypatch):
    env, asked = make_batch_env(cache_of_gpu_table, monkeypatch, seeds=(0, 1))
    everyone = np.arange(4)
    one_by_one = InitialStates.from_layouts([env.layout(i) for i in range(4)], "cpu")
    assert_equal_states(env.seeds.find_initial_states(everyone, env.device), one_by_one)
    assert asked == [[(0, 0), (1, 1), (0, 0), (1, 1)]]
    for _ in range(20):
        env.reset()
    assert {seed for one in asked for _, seed in one} == {0, 1}
    assert all([objects for objects, _ in one] == [0, 1, 0, 1] for one in asked)
    env.reset(options={"env_idx": torch.tensor([2])})
    assert [objects for objects, _ in asked[-1]] == [0]
    assert_equal_states(
        env.seeds.find_initial_states(np.array([2]), env.device), InitialStates.from_layouts([env.layout(2)], "cpu")
    )
    assert env.layouts[0].object_ids == env.seeds.object_ids[2] == env.seeds.object_ids[0] != env.seeds.object_ids[1]


def test_unstable_layouts_are_not_drawn_and_are_errors_when_requested(cache_of_gpu_table, monkeypatch):
    env, _ = make_batch_env(cache_of_gpu_table, monkeypatch, num_envs=2, seeds=(0, 2))
    layouts: Any = env.seeds.layouts
    layouts.write_statuses(
        "gpu", {(0, 1): LayoutStatus.UNSTABLE, (1, 1): LayoutStatus.UNSTABLE, (1, 2): LayoutStatus.STABLE}
    )
    env, _ = make_batch_env(cache_of_gpu_table, monkeypatch, num_envs=2, seeds=(0, 2))
    assert env.seeds.objects_seeds.tolist() == [0, 1]  # env 1 keeps its objects, and starts with another layout
    for _ in range(20):
        env.reset()
        assert env.seeds.find_initial_states(np.arange(2), env.device).targets.shape == (2,)
        assert 1 not in env.seeds.layout_seeds
    with pytest.raises(LayoutError, match="objects seed 0, seed 1: the objects of this layout are not stable"):
        env.reset(seed=[1, 0])


def test_objects_without_stable_layout_are_not_used(cache_of_gpu_table, monkeypatch, caplog):
    env, _ = make_batch_env(cache_of_gpu_table, monkeypatch, num_envs=2, seeds=(0, 2))
    layouts: Any = env.seeds.layouts
    layouts.write_statuses("gpu", {pair: LayoutStatus.UNSTABLE for pair in [(0, 0), (0, 2), (1, 0), (1, 1), (1, 2)]})
    for _ in range(10):
        env, _ = make_batch_env(cache_of_gpu_table, monkeypatch, num_envs=2, seeds=(0, 1))
        assert env.seeds.objects_seeds.tolist() == [0, 0]
        for _ in range(10):
            env._set_episode_rng(None, torch.tensor([0, 1]))
            assert env.seeds.find_initial_states(np.arange(2), env.device).targets.shape == (2,)
            assert env.seeds.layout_seeds.tolist() == [1, 1]
    assert not [record for record in caplog.records if record.levelname == "WARNING"]


def test_failed_reset_does_not_change_the_envs(cache_of_gpu_table, monkeypatch):
    env, _ = make_batch_env(cache_of_gpu_table, monkeypatch, num_envs=2, seeds=(0, 2))
    layouts: Any = env.seeds.layouts
    layouts.write_statuses("gpu", {(0, 1): LayoutStatus.UNSTABLE})
    env, _ = make_batch_env(cache_of_gpu_table, monkeypatch, num_envs=2, seeds=(0, 2))
    env.reset(seed=[2, 0])
    before = [env.layout(i).object_poses for i in range(2)]
    for _ in range(3):
        with pytest.raises(LayoutError):
            env.reset(seed=[1, 2])
    assert env.seeds.layout_seeds.tolist() == [2, 0]
    np.testing.assert_array_equal([env.layout(i).object_poses for i in range(2)], before)
    layouts.write_statuses("gpu", {(0, 1): LayoutStatus.STABLE})
    env.reset(options={"reconfigure": True}, seed=[0, 1])
    env.reset(seed=[1, 2])  # the failed reset left no state


def test_layouts_missing_in_the_table_come_from_the_cache(cache_with_table, tmp_path, monkeypatch):
    shutil.copytree(cache_with_table, tmp_path, dirs_exist_ok=True)
    table = next(tmp_path.glob("*/table-cpu.npy"))
    table.rename(table.with_name("table-gpu.npy"))
    env, _ = make_batch_env(tmp_path, monkeypatch, num_envs=2, seeds=(0, 1))
    env.reset(seed=[1, 7])
    assert env.seeds.table is not None
    assert env.seeds.table.status((1, 7)) == LayoutStatus.MISSING
    found = env.seeds.find_initial_states(np.array([0, 1]), env.device)
    assert_equal_states(found, InitialStates.from_layouts([env.seeds.layouts(0, 1), env.seeds.layouts(1, 7)], "cpu"))


def test_one_env_that_keeps_its_objects_resets_from_a_table(cache_with_table, monkeypatch):
    monkeypatch.setattr(cache, "sample_layout", None)
    made = gym.make("RoboCASPick-v1", layouts=cache_with_table, reconfiguration_freq=0, seeds=(0, 2), **STATE_ONLY)
    env: Any = made.unwrapped
    assert env.seeds.initial_state_table is not None
    for seed in (2, 0):
        made.reset(seed=seed)
        wanted = read_layout(env.seeds.layouts.layout_path(env.seeds.objects_seeds[0], seed))
        torch.testing.assert_close(
            env.object_poses, InitialStates.from_layouts([wanted], "cpu").object_poses, atol=1e-6, rtol=0
        )
        assert int(env.target_slot) == wanted.target
    made.close()
