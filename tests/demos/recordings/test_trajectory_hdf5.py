"""HDF5 files of trajectories: full disks, merged files, and files with external references."""

# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportArgumentType=false
import errno
import json
import os
import resource
import threading
from contextlib import contextmanager

import h5py
import numpy as np
import pytest
from synthetic import STEPS, write_trajectory

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import atomic_file
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile
from robocas_ms3.demos.recordings.trajectory_hdf5 import find_violation, merge, open_reserved, write_hdf5
from robocas_ms3.demos.trajectory_replay import RecordedEpisode
from robocas_ms3.evaluation.policies.replay import ReplayPolicy
from robocas_ms3.evaluation.policy import EpisodeSpec

DATA = np.arange(50_000, dtype=np.float64)
CUBE = "traj_0/env_states/actors/object_1"
SECRET = np.full((STEPS + 1, 13), 7, np.float32)
SECRET[:, 3:7] = [1, 0, 0, 0]


@contextmanager
def files_of_at_most(size):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def fill(file):
    file.create_group("a", track_order=True).create_dataset("b", data=DATA)


@pytest.mark.parametrize("size", [1, 10_000_000, None])
def test_unused_reserved_space_is_released(tmp_path, monkeypatch, size):
    def none(*_):
        raise OSError(errno.EOPNOTSUPP, "Operation not supported")

    if size is None:  # a file system that reserves nothing
        monkeypatch.setattr("os.posix_fallocate", none)
    with open_reserved(tmp_path / "x.h5", size or 10) as file:
        fill(file)
    with h5py.File(tmp_path / "x.h5") as file:
        np.testing.assert_array_equal(file["a/b"], DATA)
    assert os.path.getsize(tmp_path / "x.h5") < DATA.nbytes + 10_000


def test_full_disk_is_an_error_without_data_loss(tmp_path):
    """HDF5 does not crash when it closes the file, and no file is left."""
    with files_of_at_most(100_000):
        with pytest.raises(OSError, match="x.h5") as error, atomic_file(tmp_path / "x.h5") as tmp:
            write_hdf5(tmp, fill)
        assert error.value.errno == errno.EFBIG
        with pytest.raises(OSError, match="y.h5"), atomic_file(tmp_path / "y.h5") as tmp, open_reserved(tmp, 500_000):
            raise AssertionError("it was opened")
    assert list(tmp_path.iterdir()) == []


def cut_off(path):
    os.truncate(path, path.stat().st_size - 1)


def without_json(path):
    path.with_suffix(".json").unlink()


def without_an_action(path):
    with h5py.File(path, "r+") as file:
        actions = file["traj_1/actions"][:-1]
        del file["traj_1/actions"]
        file["traj_1/actions"] = actions


def without_an_episode(path):
    with h5py.File(path, "r+") as file:
        del file["traj_1"]


def with_another_number(path):
    text = path.with_suffix(".json").read_text()
    path.with_suffix(".json").write_text(text.replace('"episode_id": 0', '"episode_id": 5'))


@pytest.mark.parametrize("damage", [cut_off, without_json, without_an_action, without_an_episode, with_another_number])
def test_violations_of_a_merged_file_are_found(tmp_path, damage):
    path = tmp_path / "merged.h5"
    merge([write_trajectory(tmp_path / f"{seed}.h5", seeds=(seed,)) for seed in (7, 3)], path)
    assert find_violation(path, [7, 3]) == ""
    assert "wrong episodes" in find_violation(path, [3, 7])
    damage(path)
    assert find_violation(path, [7, 3])


@pytest.fixture
def whole(tmp_path):
    """Return a recording with another file next to it."""
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
        return file.read_recording(0)


def by_merge(path):
    merge([path], path.with_name("merged.h5"))


def by_replay(path):
    return RecordedEpisode.read(path, json.loads(path.with_suffix(".json").read_text())["episodes"][0])


def by_policy(path):
    return ReplayPolicy(path).make_track(EpisodeSpec(0, 0, "", "", "", "", 3, "")).actions


def check_refused(read, path, *words):
    with pytest.raises(DatasetError) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("fill", [external_link, external_numbers, virtual, soft_link])
@pytest.mark.parametrize("read", [by_file, by_merge, by_replay])
def test_states_in_other_files_are_errors(whole, fill, read):
    replaced(whole, CUBE, fill)
    if fill is soft_link:
        with h5py.File(whole, "r+") as file:
            del file["elsewhere"]
            file[CUBE.rpartition("/")[0]].create_dataset("more", data=SECRET)
    check_refused(read, whole, "refers to data outside", "object_1", "arrays stored in this file")
    assert not whole.with_name("merged.h5").exists()


@pytest.mark.parametrize("read", [by_file, by_merge, by_replay, by_policy])
@pytest.mark.parametrize("name", ["traj_0/actions", "traj_0"])
def test_links_to_actions_or_episodes_are_errors(whole, read, name):
    replaced(whole, name, external_link)
    check_refused(read, whole, "refers to data outside", name.rpartition("/")[2])


@pytest.mark.parametrize("read", [by_file, by_replay])
def test_huge_declared_states_are_an_error(whole, read):
    """A small file can declare terabytes; they are not allocated."""
    huge = {"shape": (2**33, 2**33), "dtype": np.float32, "chunks": (1024, 1024), "compression": "gzip"}
    replaced(whole, CUBE, lambda file, name: file.create_dataset(name, **huge))
    check_refused(read, whole, "MB of arrays")


def test_cyclic_groups_are_handled(whole):
    with h5py.File(whole, "r+") as file:
        file["traj_0/env_states/ring"] = file["traj_0/env_states"]
    check_refused(by_replay, whole, "damaged")
    assert by_file(whole).control_steps == STEPS  # which reads bodies alone


def test_other_threads_can_read_files_while_an_error_is_referenced(whole):
    """Iterators of h5py hold its lock: tests hung when another thread freed the traceback of the error."""
    with h5py.File(whole, "r+") as file:
        file["traj_0/env_states/ring"] = file["traj_0/env_states"]
    with pytest.raises(DatasetError) as kept:
        by_replay(whole)
    thread = threading.Thread(target=by_file, args=[whole], daemon=True)
    thread.start()
    thread.join(timeout=20)
    assert not thread.is_alive() and kept.tb


@pytest.mark.parametrize("name", ["actions", "env_states/actors/object_1"])
def test_nan_in_a_recording_is_an_error(whole, name):
    with h5py.File(whole, "r+") as file:
        file[f"traj_0/{name}"][4, 2] = np.nan
    for read in (by_file, by_replay, *([by_policy] if name == "actions" else [])):
        check_refused(read, whole, "NaN or infinite value", name.rpartition("/")[2], "row 4")
