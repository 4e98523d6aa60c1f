"""Refused datasets: base motion, rotated TCP frame, NaN, missing cameras or embeddings."""

import json
import shutil

import h5py
import numpy as np
import pytest
from rt1_sizes import SIZES
from small_sizes import TINY
from synthetic import write_trajectory

from robocas_ms3.baselines.bc_state import BASELINE as BC_STATE
from robocas_ms3.baselines.bc_state import BcStateConfig
from robocas_ms3.baselines.dataset_checks import check_base_is_fixed, check_tcp_frame
from robocas_ms3.baselines.rt1 import BASELINE as RT1
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.small import BASELINE as SMALL
from robocas_ms3.baselines.small.config import SmallConfig
from robocas_ms3.core.errors import DatasetError, EmptySplitError
from robocas_ms3.datasets.formats import open_source

LEARNERS = {"rt1": (RT1, RT1Config(**SIZES)), "small": (SMALL, SmallConfig(**TINY))}


def read(name, path, split="train"):
    baseline, config = LEARNERS[name]
    return baseline.data(config, path, split, lambda done, total: None)


def spoil_arrays(folder, number, **columns):
    """Write a NaN, or add values, to columns of an array."""
    path = folder / f"episode_{number:07d}" / "episode_info.npz"
    arrays = dict(np.load(path))
    for key, change in columns.items():
        arrays[key][:] = change(arrays[key])
    np.savez(path, **arrays)


def set_values(folder, name="conversion.json", **values):
    path = folder / name
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


@pytest.mark.parametrize("name", LEARNERS)
@pytest.mark.parametrize(
    "values", [{"embeddings": False}, {"cameras": ["base_camera"]}, {"cameras": []}, {"rate_hz": 10.0}], ids=str
)
def test_missing_cameras_embeddings_or_another_rate_are_refused(name, values, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "dataset")
    set_values(copy, **values)
    with pytest.raises(DatasetError) as caught:
        read(name, copy)
    assert caught.value.where == copy


@pytest.mark.parametrize("name", LEARNERS)
def test_a_recording_is_not_a_dataset_with_images(name, tmp_path):
    recording = write_trajectory(tmp_path / "trajectory.h5")
    for path in (tmp_path, recording):
        with pytest.raises(DatasetError) as caught:
            read(name, path)
        assert (caught.value.where, caught.value.found) == (path, "a recording")
        assert f"robocas convert {recording} " in caught.value.fix


@pytest.mark.parametrize("name", LEARNERS)
def test_empty_split_is_refused(name, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "dataset")
    set_values(copy, "data_info.json", val_eps=[])
    with pytest.raises(EmptySplitError):
        read(name, copy, "val")


@pytest.mark.parametrize(
    ("name", "key"),
    [("rt1", "rel_pos"), ("rt1", "language_embedding"), ("small", "ee_pos"), ("small", "gripper_width")],
)
def test_nan_is_found_before_training(name, key, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "dataset")
    number = open_source(copy).split("train")[-1]
    spoil_arrays(copy, number, **{key: lambda values: np.nan})
    with pytest.raises(DatasetError) as caught:
        read(name, copy)
    assert str(caught.value.where).endswith(f"episode {number}, {key}")


def test_small_base_motion_is_allowed():
    motion = np.zeros((200, 3), np.float32)
    motion[::2], motion[1::2] = 1e-4, -1e-4
    check_base_is_fixed(motion, "here")
    check_base_is_fixed(motion[:0], "here")


@pytest.mark.parametrize("column", [0, 1, 2])
@pytest.mark.parametrize("rows", [[0.02, 0, 0], [0.02, -0.02, 0], [0.002] * 10, [-0.002] * 10, [0, np.nan, 0]])
def test_fast_and_slow_base_motion_is_refused(column, rows):
    motion = np.zeros((len(rows), 3))
    motion[:, column] = rows
    with pytest.raises(DatasetError) as caught:
        check_base_is_fixed(motion, "here")
    assert caught.value.where == "here"


@pytest.mark.parametrize(("name", "split"), [("rt1", "train"), ("small", "val")])
def test_baselines_refuse_base_motion(folder, tmp_path, name, split):
    copy = shutil.copytree(folder, tmp_path / "dataset")
    number = open_source(copy).split(split)[0]
    spoil_arrays(copy, number, rel_agv_pose=lambda motion: motion + np.float32([0.08, 0, 0]))
    with pytest.raises(DatasetError) as caught:
        read(name, copy, split)
    assert caught.value.where == f"{copy}, episode {number}"


def test_bc_state_refuses_base_motion_before_making_an_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOCAS_CACHE", str(tmp_path / "cache"))
    path = write_trajectory(tmp_path / "F.h5")
    with h5py.File(path, "r+") as file:
        states = file["traj_0/env_states/articulations/robocas_mobile_panda"]
        states[:, 13] = np.linspace(0, 0.5, len(states))
    with pytest.raises(DatasetError) as caught:
        BC_STATE.data(BcStateConfig(), path, "train", lambda done, total: None)
    assert caught.value.where == f"{path}, episode 0"
    assert not (tmp_path / "cache" / "bc-state").exists()


@pytest.mark.parametrize(("name", "camera", "turn"), [("rt1", (0.0, 0.05), -90), ("small", (0.0, -0.05), 90)])
def test_actions_in_a_rotated_tcp_frame_are_refused(folder, tmp_path, name, camera, turn):
    """ManiSkill's gripper camera is on the x side of its TCP."""
    copy = shutil.copytree(folder, tmp_path / "dataset")
    for path in copy.glob("episode_*/gripper_camera/cam_pos*_wrt_ee.npy"):
        pose = np.load(path)
        pose[:2, 3] = camera
        np.save(path, pose)
    read(name, copy)  # a configuration may move the camera
    for episode in copy.glob("episode_*"):  # as in a dataset of another package
        set_values(episode, "scene.json", env_info=None)
    with pytest.raises(DatasetError) as caught:
        read(name, copy)
    assert f"{turn} degrees" in caught.value.found and "import-robocas" in caught.value.fix


def test_without_gripper_camera_scene_json_is_needed(folder, tmp_path):
    """Episodes of RoboCAS-v0 have no scene.json."""
    copy = shutil.copytree(folder, tmp_path / "dataset")
    set_values(copy, cameras=["base_camera"])
    check_tcp_frame(open_source(copy), 0)
    (copy / "episode_0000000" / "scene.json").unlink()
    with pytest.raises(DatasetError) as caught:
        check_tcp_frame(open_source(copy), 0)
    assert str(caught.value.where).endswith("episode_0000000")
