"""A recording chooses no files: whatever of HDF5 names another one is refused, wherever an episode is opened."""

# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportArgumentType=false
import json

import h5py
import numpy as np
import pytest
from synthetic import STEPS, write_trajectory

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.demos.recordings.reading import TrajectoryFile
from robocas_ms3.demos.recordings.stored import merge
from robocas_ms3.demos.replay import Recorded
from robocas_ms3.evaluation.policies.replay import ReplayPolicy
from robocas_ms3.evaluation.policy import EpisodeSpec

CUBE = "traj_0/env_states/actors/object_1"
SECRET = np.full((STEPS + 1, 13), 7, np.float32)
SECRET[:, 3:7] = [1, 0, 0, 0]


@pytest.fixture
def whole(tmp_path):
    """A recording, and a file of somebody else beside it."""
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file.create_dataset("states", data=SECRET)
        file.create_dataset("actions", data=np.zeros((STEPS, 8), np.float32))
    (tmp_path / "secret.bin").write_bytes(SECRET.tobytes())
    return write_trajectory(tmp_path / "F.h5", seeds=(3,))


def replaced(path, name, fill):
    with h5py.File(path, "r+") as file:
        del file[name]
        fill(file, name)


def external_link(file, name):
    file[name] = h5py.ExternalLink("secret.h5", "actions" if name.endswith("actions") else "states")


def soft_link(file, name):
    file["elsewhere"] = file.create_dataset("traj_0/kept", data=SECRET)
    file[name] = h5py.SoftLink("/elsewhere")


def external_numbers(file, name):
    file.create_dataset(name, SECRET.shape, np.float32, external=[("secret.bin", 0, SECRET.nbytes)])


def virtual(file, name):
    layout = h5py.VirtualLayout(SECRET.shape, np.float32)
    layout[:] = h5py.VirtualSource("secret.h5", "states", SECRET.shape)
    file.create_virtual_dataset(name, layout)


def by_file(path):
    with TrajectoryFile(path) as file:
        return file.recording(0)


def by_merge(path):
    merge([path], path.with_name("merged.h5"))


def by_replay(path):
    return Recorded.read(path, json.loads(path.with_suffix(".json").read_text())["episodes"][0])


def by_policy(path):
    return ReplayPolicy(path).track(EpisodeSpec(0, 0, "", "", "", "", 3, "")).actions


def refused(read, path, *words):
    with pytest.raises(DatasetError) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("fill", [external_link, external_numbers, virtual, soft_link])
@pytest.mark.parametrize("read", [by_file, by_merge, by_replay])
def test_states_of_other_files(whole, fill, read):
    replaced(whole, CUBE, fill)
    if fill is soft_link:
        with h5py.File(whole, "r+") as file:
            del file["elsewhere"]
            file[CUBE.rpartition("/")[0]].create_dataset("more", data=SECRET)
    refused(read, whole, "can't choose files", "object_1", "arrays of its own")
    assert not whole.with_name("merged.h5").exists()


@pytest.mark.parametrize("read", [by_file, by_merge, by_replay, by_policy])
@pytest.mark.parametrize("name", ["traj_0/actions", "traj_0"])
def test_a_link_in_place_of_actions_or_of_the_episode(whole, read, name):
    replaced(whole, name, external_link)
    refused(read, whole, "can't choose files", name.rpartition("/")[2])


@pytest.mark.parametrize("read", [by_file, by_replay])
def test_states_said_to_be_huge(whole, read):
    """A kilobyte of a file can stand for terabytes: they are not asked for."""
    huge = {"shape": (2**33, 2**33), "dtype": np.float32, "chunks": (1024, 1024), "compression": "gzip"}
    replaced(whole, CUBE, lambda file, name: file.create_dataset(name, **huge))
    refused(read, whole, "MB of numbers")


def test_a_ring_of_groups_ends(whole):
    with h5py.File(whole, "r+") as file:
        file["traj_0/env_states/ring"] = file["traj_0/env_states"]
    refused(by_replay, whole, "damaged")
    assert by_file(whole).control_steps == STEPS  # which reads bodies alone


@pytest.mark.parametrize("name", ["actions", "env_states/actors/object_1"])
def test_nan_is_not_replayed(whole, name):
    with h5py.File(whole, "r+") as file:
        file[f"traj_0/{name}"][4, 2] = np.nan
    for read in (by_file, by_replay, *([by_policy] if name == "actions" else [])):
        refused(read, whole, "NaN or infinity", name.rpartition("/")[2], "row 4")
