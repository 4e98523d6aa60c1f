"""Datasets store the nominal and the true poses of cameras that were moved at random."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from recorded_candidates import write_recorded_candidates
from synthetic import CAMERA_IN_PARENT, RayCaster, write_trajectory

from robocas_ms3.core.poses import from_xyzw, inverse
from robocas_ms3.datasets.candidate_images.images_file import CandidateImages
from robocas_ms3.datasets.candidate_images.render import render_candidates
from robocas_ms3.datasets.candidate_images.settings import CandidateImageSettings
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.formats import open_source

SHIFT = np.eye(4)
SHIFT[:3, 3] = 0.05, -0.03, 0.02
NOMINAL = {name: true @ inverse(SHIFT) for name, true in CAMERA_IN_PARENT.items()}


class MovedCameras(RayCaster):
    """Renderer whose cameras were moved by `SHIFT` in their frames."""

    def cameras(self):
        return {name: replace(model, camera_in_parent=NOMINAL[name]) for name, model in super().cameras().items()}


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory):
    return write_trajectory(tmp_path_factory.mktemp("trajectory") / "F.h5", seeds=(3,))


@pytest.fixture(scope="module")
def folder(trajectory, tmp_path_factory):
    out = tmp_path_factory.mktemp("datasets") / "robocas"
    convert(ConversionSettings(trajectory, out, video=False, embeddings=False, open_renderer=MovedCameras))
    return out


def check_episode(episode) -> None:
    for camera, true in CAMERA_IN_PARENT.items():
        np.testing.assert_array_equal(episode.camera_in_parent(camera), NOMINAL[camera])
        np.testing.assert_array_equal(episode.true_camera_in_parent(camera), true)
    arrays = {key: array.astype(np.float64) for key, array in episode.arrays.items() if array.dtype.kind == "f"}
    tcp = from_xyzw(arrays["ee_pos"], arrays["ee_orn"])
    base = from_xyzw(arrays["base_pos"], arrays["base_orn"])
    expected = {
        "base_camera": np.broadcast_to(NOMINAL["base_camera"], tcp.shape),
        "gripper_camera": tcp @ NOMINAL["gripper_camera"],
        "static_camera": inverse(base) @ NOMINAL["static_camera"],
    }
    for camera, poses in expected.items():
        np.testing.assert_allclose(episode.camera_in_base(camera), poses, atol=1e-6)


def test_robocas_folder(folder):
    """The depth images are checked against the true poses."""
    assert validate(folder).violations == []
    check_episode(open_source(folder).episode(0))


@pytest.mark.parametrize("damage", ["missing", "scaled"])
def test_file_of_the_true_pose(folder, tmp_path, damage):
    copy = shutil.copytree(folder, tmp_path / "copy")
    path = copy / "episode_0000000/base_camera/true_cam_pose_wrt_arm_base.npy"
    if damage == "scaled":
        np.save(path, 2 * np.load(path))
        assert [one.file for one in validate(copy).violations] == [str(path.relative_to(copy))]
    else:
        path.unlink()
        pose = open_source(copy).episode(0).true_camera_in_parent("base_camera")
        np.testing.assert_array_equal(pose, NOMINAL["base_camera"])


def test_nominal_pose_in_another_convention_is_reported(folder, tmp_path):
    """A pose in the OpenGL frame is turned by 180 degrees."""
    copy = shutil.copytree(folder, tmp_path / "copy")
    camera = copy / "episode_0000000/static_camera"
    for name in ("cam_pos_wrt_world.npy", "cam_pose_wrt_world.npy"):
        np.save(camera / name, np.load(camera / name) @ np.diag([1.0, -1, -1, 1]))
    (violation,) = validate(copy).violations
    assert violation.file == "episode_0000000/static_camera/true_cam_pose_wrt_world.npy"
    assert violation.found.endswith("180 degrees")


def test_lerobot_dataset(folder, trajectory, tmp_path):
    pytest.importorskip("av", reason="needs the extra 'lerobot'")
    pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
    from robocas_ms3.datasets.lerobot.convert import convert_lerobot

    for number, source in enumerate((trajectory, folder)):
        out = tmp_path / str(number)
        convert_lerobot(ConversionSettings(source, out, open_renderer=MovedCameras))
        check_episode(open_source(out).episode(0))


def test_candidate_images(trajectory, tmp_path):
    candidates = write_recorded_candidates(tmp_path / "candidates.h5", trajectory, (0, 8))
    render_candidates(CandidateImageSettings(candidates, open_renderer=MovedCameras))
    images = CandidateImages(tmp_path / "candidates_images.h5")
    for row in range(2):
        for camera in images.cameras:
            difference = inverse(images.camera_in_base(row, camera)) @ images.true_camera_in_base(row, camera)
            np.testing.assert_allclose(difference, SHIFT, atol=1e-6)
        true = images.true_camera_in_base(row, "base_camera")
        np.testing.assert_allclose(true, CAMERA_IN_PARENT["base_camera"], atol=1e-6)
