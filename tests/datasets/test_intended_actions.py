"""Datasets of demonstrations with action noise: labels are intended actions, in all formats and checks."""

import shutil

import h5py
import numpy as np
import pytest
from managing import convert_made_up
from synthetic import RayCaster, add_action_noise, write_trajectory

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.poses import from_xyzw, inverse
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.checks.replay import replay_dataset
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.manage.merge import merge
from robocas_ms3.datasets.sources.arrays import compute_motion_arrays
from robocas_ms3.datasets.sources.trajectory import TrajectorySource


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    return add_action_noise(write_trajectory(tmp_path_factory.mktemp("noisy") / "F.h5", seeds=(3, 4)))


@pytest.fixture(scope="module")
def folder(noisy):
    out = noisy.parent / "robocas"
    convert_made_up(noisy, out)
    return out


def poses(arrays, position, orientation):
    return from_xyzw(arrays[position].astype(np.float64), arrays[orientation].astype(np.float64))


def test_motion_leads_from_the_reached_to_the_intended_pose(noisy, folder):
    arrays = open_source(folder).episode(1).arrays
    reached, intended = poses(arrays, "ee_pos", "ee_orn"), poses(arrays, "intended_ee_pos", "intended_ee_orn")
    motion = poses(arrays, "rel_pos", "rel_orn")
    np.testing.assert_allclose(reached[:-1] @ motion[:-1], intended[1:], atol=1e-5)
    np.testing.assert_allclose(intended[0], reached[0], atol=1e-6)
    assert np.linalg.norm(intended[1:, :3, 3] - reached[1:, :3, 3], axis=1).min() > 1e-4
    with h5py.File(noisy) as file:
        deviations = file["traj_1/joint_deviations"][3::4]  # at the ends of the dataset steps, except for the last
    found = (arrays["robot_joints"] - arrays["intended_joints"])[1 : len(deviations) + 1]
    np.testing.assert_allclose(found, deviations, atol=1e-6)


def test_trajectory_file_and_folder_have_equal_arrays(noisy, folder):
    expected = TrajectorySource(noisy).episode(0).arrays
    arrays = open_source(folder).episode(0).arrays
    assert list(arrays) == list(expected)
    for key, values in expected.items():
        np.testing.assert_array_equal(arrays[key], values)


def test_folder_is_valid_and_wrong_labels_are_found(folder, tmp_path):
    assert validate(folder).violations == []
    other = shutil.copytree(folder, tmp_path / "other")
    path = other / "episode_0000000" / "episode_info.npz"
    arrays = dict(np.load(path))
    executed = {key: values for key, values in arrays.items() if not key.startswith("intended")}
    keys = ("ee_pos", "ee_orn", "rel_pos", "rel_orn")
    np.savez(path, **{**arrays, **compute_motion_arrays(executed, keys)})
    assert {wrong.key for wrong in validate(other).violations} >= {"rel_pos", "rel_orn"}


def test_open_loop_replay_is_skipped(folder):
    assert ["noise" in episode.skipped for episode in replay_dataset(folder).episodes] == [True, True]


def test_merge_with_a_dataset_without_noise(folder, tmp_path):
    plain = tmp_path / "plain"
    convert_made_up(write_trajectory(tmp_path / "G.h5", seeds=(5,)), plain)
    out = tmp_path / "merged"
    merge([folder, plain], out)
    assert validate(out).violations == []
    has_noise = ["intended_joints" in open_source(out).episode(number).arrays for number in range(3)]
    assert has_noise == [True, True, False]


@pytest.mark.parametrize("source", ["noisy", "folder"])
def test_lerobot_dataset_has_intended_actions_and_the_same_arrays(request, folder, source, tmp_path):
    pytest.importorskip("av", reason="needs the extra 'lerobot'")
    pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
    from robocas_ms3.datasets.lerobot.check import check_lerobot
    from robocas_ms3.datasets.lerobot.convert import convert_lerobot

    root, source = tmp_path / "lerobot", request.getfixturevalue(source)
    convert_lerobot(ConversionSettings(source, root, open_renderer=RayCaster, cameras=("base_camera",)))
    assert check_lerobot(root).violations == []
    episode, expected = open_source(root).episode(1), open_source(folder).episode(1).arrays
    np.testing.assert_array_equal(episode.columns["action.joint"][:-1, :7], expected["intended_joints"][1:])
    np.testing.assert_array_equal(episode.columns["action"][:, :3], expected["rel_pos"])
    assert set(episode.arrays) == set(expected)
    for keys in (("rel_pos", "rel_orn"), ("intended_ee_pos", "intended_ee_orn")):
        difference = inverse(poses(episode.arrays, *keys)) @ poses(expected, *keys)
        np.testing.assert_allclose(difference, np.tile(np.eye(4), (len(difference), 1, 1)), atol=1e-5)
    np.testing.assert_array_equal(episode.arrays["intended_joints"], expected["intended_joints"])


@pytest.mark.parametrize("change", ["missing", "shape", "nan"])
def test_damaged_deviations_are_an_error(tmp_path, change):
    path = add_action_noise(write_trajectory(tmp_path / "F.h5", seeds=(3,)))
    with h5py.File(path, "r+") as file:
        values = file["traj_0/joint_deviations"][()]
        del file["traj_0/joint_deviations"]
        if change != "missing":
            values[2, 3] = np.nan
            file["traj_0/joint_deviations"] = values[:5] if change == "shape" else values
    with pytest.raises(DatasetError) as error:
        TrajectorySource(path).episode(0).arrays  # noqa: B018
    assert "traj_0" in str(error.value.where)
