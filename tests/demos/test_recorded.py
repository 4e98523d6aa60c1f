"""What a replay is told of an episode is checked before: whatever its files say, it is read or refused in one line."""

# pyright: reportIndexIssue=false, reportArgumentType=false
import json
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from fuzzing import VALUES, flipped
from synthetic import STEPS, write_trajectory

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.demos.replay import Recorded, replay
from robocas_ms3.demos.settings import ReplaySettings

SEED = "episode_seed"


@pytest.fixture
def trajectory(tmp_path):
    return write_trajectory(tmp_path / "F.h5", seeds=(3,))


def entry(trajectory):
    return json.loads(trajectory.with_suffix(".json").read_text())["episodes"][0]


@pytest.mark.parametrize("text", [b"{}", b"[]", b"7", b"", b"\xff{}", b'{"episodes": [NaN]}', b'{"episodes": {}}'])
def test_json_that_is_none_of_a_trajectory(trajectory, text):
    trajectory.with_suffix(".json").write_bytes(text)
    with pytest.raises(DatasetError, match="not a trajectory's JSON") as caught:
        replay(ReplaySettings(trajectory))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", [SEED, "control_mode", "reset_kwargs"])
def test_values_of_an_entry(trajectory, key):
    whole = entry(trajectory)
    for value in VALUES:
        try:
            found = Recorded.read(trajectory, {**whole, key: value})
        except DatasetError as error:
            assert "\n" not in str(error)
        else:
            assert key != SEED or value == found.seed
    with pytest.raises(DatasetError, match="episode_seed"):
        Recorded.read(trajectory, {**whole, SEED: "3"})


def test_bytes_of_the_file(trajectory):
    whole, said, refused = trajectory.read_bytes(), entry(trajectory), 0
    for seed in range(60):
        trajectory.write_bytes(flipped(whole, seed))
        try:
            assert np.isfinite(Recorded.read(trajectory, said).actions).all()
        except DatasetError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 8


def env_like(recorded, **changes):
    """What `check_fits` asks of an environment: one step of the recording, as tensors of one env."""
    import torch

    bodies = {kind: {n: torch.tensor(row)[None] for n, row in of.items()} for kind, of in recorded.states[0].items()}
    return SimpleNamespace(
        control_mode=changes.get("control_mode", recorded.control_mode),
        single_action_space=np.zeros(changes.get("actions", 8)),
        get_state_dict=lambda: {**bodies, "controller": {}},
    )


def test_only_a_scene_like_the_recorded_one_fits(trajectory):
    recorded = Recorded.read(trajectory, entry(trajectory))
    recorded.check_fits(env_like(recorded))
    recorded.check_fits(env_like(recorded, control_mode="pd_ee_pose", actions=7))
    with pytest.raises(DatasetError, match="actions of another robot .expected 7 numbers, found 8"):
        recorded.check_fits(env_like(recorded, actions=7))
    with h5py.File(trajectory, "r+") as file:
        bodies = file["traj_0/env_states/actors"]
        bodies["guest"] = bodies["object_0"][:]
        file["traj_0/env_states/controller/arm"] = np.zeros((STEPS + 1, 7), np.float32)
    other = Recorded.read(trajectory, entry(trajectory))
    with pytest.raises(DatasetError, match="actors/guest: states of another scene .expected nothing of this name"):
        other.check_fits(env_like(recorded))
    with pytest.raises(DatasetError, match="actors/guest: .*expected 13 numbers, found nothing"):
        recorded.check_fits(env_like(other))
