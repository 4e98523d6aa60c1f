"""Merged trajectories, and what is wrong with one."""

import json
import os

import h5py
import pytest
from synthetic import write_trajectory

from robocas_ms3.demos.recordings.stored import damage_of, merge


@pytest.fixture
def merged(tmp_path):
    shards = [write_trajectory(tmp_path / f"{seed}.h5", seeds=(seed,)) for seed in (7, 3)]
    path = tmp_path / "merged.h5"
    merge(shards, path)
    return path


def test_one_that_is_whole_holds_all_in_order(merged):
    assert damage_of(merged, [7, 3]) == ""
    assert "other episodes" in damage_of(merged, [3, 7])
    assert "other episodes" in damage_of(merged, [7])


@pytest.mark.parametrize("size", [0, 1000, -1])
def test_one_that_was_cut_off(merged, size):
    os.truncate(merged, size if size >= 0 else merged.stat().st_size + size)
    assert "can't read this HDF5 file" in damage_of(merged, [7, 3])


def test_one_that_is_not_there(merged):
    merged.with_suffix(".json").unlink()
    assert "JSON that belongs to this trajectory is missing" in damage_of(merged, [7, 3])
    merged.unlink()
    assert "no such trajectory file" in damage_of(merged, [7, 3])


def test_one_that_lacks_an_episode_or_a_part_of_one(merged):
    with h5py.File(merged, "r+") as file:
        actions = file["traj_1/actions"][:-1]
        del file["traj_1/actions"]
        file["traj_1/actions"] = actions
    assert "traj_1: this episode is damaged" in damage_of(merged, [7, 3])
    with h5py.File(merged, "r+") as file:
        del file["traj_1"]
    assert "found 2, 1 as HDF5" in damage_of(merged, [7, 3])


def test_a_json_of_something_else(merged):
    path = merged.with_suffix(".json")
    said = json.loads(path.read_text())
    said["episodes"][0]["episode_id"] = 5
    path.write_text(json.dumps(said))
    assert "damaged" in damage_of(merged, [7, 3])
