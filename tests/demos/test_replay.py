"""Replay: checks that the scene fits the recording, and comparison of final states."""

# pyright: reportIndexIssue=false, reportArgumentType=false
import json
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch
from synthetic import STEPS, write_trajectory

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.demos.trajectory_replay import RecordedEpisode, compute_state_distance


@pytest.fixture
def trajectory(tmp_path):
    return write_trajectory(tmp_path / "F.h5", seeds=(3,))


def entry(trajectory):
    return json.loads(trajectory.with_suffix(".json").read_text())["episodes"][0]


def env_like(recorded, **changes):
    """Return a stand-in for an environment in `check_compatible`: one recorded state as tensors of one env."""
    bodies = {kind: {n: torch.tensor(row)[None] for n, row in of.items()} for kind, of in recorded.states[0].items()}
    return SimpleNamespace(
        control_mode=changes.get("control_mode", recorded.control_mode),
        single_action_space=np.zeros(changes.get("actions", 8)),
        get_state_dict=lambda: {**bodies, "controller": {}},
    )


def test_incompatible_scene_is_an_error(trajectory):
    recorded = RecordedEpisode.read(trajectory, entry(trajectory))
    recorded.check_compatible(env_like(recorded))
    recorded.check_compatible(env_like(recorded, control_mode="pd_ee_pose", actions=7))
    with pytest.raises(DatasetError, match="actions do not fit the robot .expected 7 numbers .*, found 8"):
        recorded.check_compatible(env_like(recorded, actions=7))
    with h5py.File(trajectory, "r+") as file:
        bodies = file["traj_0/env_states/actors"]
        bodies["guest"] = bodies["object_0"][:]
        file["traj_0/env_states/controller/arm"] = np.zeros((STEPS + 1, 7), np.float32)
    other = RecordedEpisode.read(trajectory, entry(trajectory))
    with pytest.raises(DatasetError, match="actors/guest: states do not fit the scene .expected no such entry"):
        other.check_compatible(env_like(recorded))
    with pytest.raises(DatasetError, match="actors/guest: .*expected 13 numbers, found no such entry"):
        recorded.check_compatible(env_like(other))


def state(cube, cup=(0.0, 0.0), robot=(0.0, 0.0)):
    return {"actors": {"cube": np.array(cube), "cup": np.array(cup)}, "articulations": {"robot": np.array(robot)}}


def tensors(state):
    return {kind: {name: torch.tensor(value)[None] for name, value in of.items()} for kind, of in state.items()}


def test_state_distance_is_the_greatest_difference():
    assert compute_state_distance(tensors(state((1.0, 2.0), robot=(0.0, -0.5))), state((1.25, 2.0))) == 0.5


@pytest.mark.parametrize("where", [{"cube": (np.nan, 0.0)}, {"cup": (0.0, np.nan)}, {"robot": (np.nan, 1.0)}])
@pytest.mark.parametrize("swapped", [False, True])
def test_state_distance_is_nan_for_nan(where, swapped):
    sides = tensors(state(**{"cube": (0.0, 0.0), **where})), state((9.0, 0.0))
    if swapped:
        sides = tensors(sides[1]), state(**{"cube": (0.0, 0.0), **where})
    assert np.isnan(compute_state_distance(*sides))
