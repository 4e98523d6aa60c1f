"""Training samples and networks of `keyframe`."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from pydantic import ValidationError
from recorded_candidates import write_recorded_candidates
from synthetic import RayCaster, write_trajectory

from robocas_ms3.baselines.keyframe.config import KeyframeConfig
from robocas_ms3.baselines.keyframe.data import KeyframeSamples, find_labelled_grasps
from robocas_ms3.baselines.keyframe.handles import find_pulled_handle
from robocas_ms3.baselines.keyframe.network import FIRST_NAME, OFFSET_UNIT, KeyframeNetwork
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.candidate_images.render import render_candidates
from robocas_ms3.datasets.candidate_images.settings import CandidateImageSettings

OBJECTS = ["apple", "lemon", "pear"]
SIZE = (64, 64)
CONFIG = KeyframeConfig(image_size=SIZE, crop_size=SIZE, channels=(8, 8, 8, 8, 8), decoder_channels=8)


def write_candidates_of(path, seeds=(3, 4, 5, 6)):
    trajectory = write_trajectory(path.parent / "trajectory.h5", seeds)
    description = trajectory.with_suffix(".json")
    values = json.loads(description.read_text())
    for episode in values["episodes"]:
        episode["robocas"]["objects"] = OBJECTS
    description.write_text(json.dumps(values))
    return write_recorded_candidates(path, trajectory, (0, 8, 16))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = write_candidates_of(tmp_path_factory.mktemp("demos") / "candidates.h5")
    settings = {"views": 2, "segmentation": True, "size": SIZE, "open_renderer": RayCaster}
    render_candidates(CandidateImageSettings(path, **settings))
    return path.parent


@pytest.fixture(scope="module")
def validation(folder):
    return KeyframeSamples(CONFIG, folder, "val")


def test_samples_are_views_and_first_images(folder, validation):
    train = KeyframeSamples(CONFIG, folder, "train")
    # three decisions per seed: two views each, with 64 crops each in training, and three cameras at the first decision
    assert len(validation) == 9 and len(train) == 64 * 3 * 9
    assert train.facts["names"] == OBJECTS and train.facts["hand_camera"] == "gripper_camera"
    assert train.scenes.objects == OBJECTS and train.scenes.tasks == ["pick"]


def test_labels_point_to_the_centres(validation):
    """In images without augmentation, surface plus offset is the centre of the cube, half an edge away or more."""
    batch = validation.__getitems__(list(range(len(validation))))
    assert batch["image"].shape == (len(validation), 5, 64, 64) and batch["label"].shape[1:] == (16, 16)
    is_object = batch["label"] >= FIRST_NAME
    assert is_object.float().mean() > 0.02
    lengths = (batch["offset"] * OFFSET_UNIT).norm(dim=1)
    assert (lengths[~is_object] == 0).all()
    assert lengths[is_object].min() > 0.02 and lengths[is_object].max() < 0.2
    assert batch["offset"][:, 2][is_object].mean() > 0.4  # centres are 2 cm or more behind most surfaces
    known = batch["outcome"] >= 0
    assert known.any() and (batch["crop"][known][:, 1].sum(dim=(1, 2)) > 0).all()


def test_crops_depend_on_seed_and_index_only(folder):
    train = KeyframeSamples(CONFIG, folder, "train")
    first, later = train.__getitems__([5, 5 + 27]), train.__getitems__([5])
    assert torch.equal(first["image"][0], later["image"][0])
    assert not torch.equal(first["image"][0], first["image"][1])  # another crop of the same image
    seeded = CONFIG.model_copy(update={"train": CONFIG.train.model_copy(update={"seed": 1})})
    other = KeyframeSamples(seeded, folder, "train").__getitems__([5])
    assert not torch.equal(first["image"][0], other["image"][0])


def test_unreachable_grasps_have_no_label():
    failures = ["", "approach: straight_line_blocked", "approach: no_ik", "reach: goal_in_collision", ""]
    candidates = {
        "failure": np.array(failures),
        "feasible": np.array([True, False, False, False, True]),
        "primitive": np.array(["grasp", "lift", "grasp", "grasp", "push"]),
        "start_in_base": np.zeros((5, 7)),
    }
    assert find_labelled_grasps(candidates).tolist() == [True, True, False, True, False]


def test_the_handle_is_the_mean_of_successful_pulls():
    half = np.sqrt(0.5)  # TCP: x up, z along the x axis of the base
    poses = np.array(
        [[0.47, -0.27, 0.06, half, 0, half, 0], [0.49, -0.27, 0.1, half, 0, half, 0], [0.9, 0, 0, 1, 0, 0, 0]]
    )
    poses[0, 3:] = 0, half, 0, half  # half a turn about the approach
    ends = poses + [0.0, 0.5, 0, 0, 0, 0, 0]
    candidates = {
        "primitive": np.array(["pull"] * 3),
        "success": np.array([True, True, False]),
        "start_in_base": poses,
        "final_in_base": ends,
    }
    handle = find_pulled_handle(candidates)
    assert np.allclose(handle.position, [0.48, -0.27, 0.08]) and np.allclose(handle.motion, [0, 0.5, 0])
    assert np.allclose(handle.approach, [1, 0, 0]) and np.allclose(np.abs(handle.bar), [0, 0, 1])
    assert np.allclose(handle.grasp[:3, 2], [1, 0, 0]) and np.linalg.det(handle.grasp[:3, :3]) == pytest.approx(1)
    assert find_pulled_handle(candidates | {"success": np.zeros(3, bool)}) is None
    # on the bar; behind it on the door; beyond the part near the grasp; after the pull
    points = np.array([[0.49, -0.28, 0.12], [0.52, -0.27, 0.08], [0.48, -0.27, 0.2], [0.48, 0.23, 0.08]])
    assert handle.contains(points).tolist() == [True, False, False, False]
    opened = handle.move_to_end()
    assert opened.contains(points).tolist() == [False, False, False, True] and not opened.motion.any()


def test_loss_of_a_batch_decreases(validation):
    torch.manual_seed(0)
    network = KeyframeNetwork(CONFIG, validation.facts)
    batch, losses = validation.__getitems__(list(range(6))), []
    optimizer = torch.optim.Adam(network.parameters(), 0.01)
    for _ in range(12):
        metrics = network(batch)
        optimizer.zero_grad()
        metrics["loss"].backward()
        optimizer.step()
        losses.append(float(metrics["loss"].detach()))
    assert set(metrics) == {"loss", "segmentation", "offset", "pull", "text", "grasp", "cells", "names", "grasps"}
    assert np.isfinite(losses).all() and losses[-1] < 0.7 * losses[0]


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"views": 0}, "no views"),
        ({"segmentation": False}, "no segmentation"),
        ({"depth": False}, "no depth"),
        ({"size": (96, 64)}, "96 x 64 pixels"),
    ],
)
def test_unsuitable_images_are_an_error(folder, tmp_path, changes, found):
    path = Path(shutil.copy(folder / "candidates.h5", tmp_path))
    settings = {"views": 1, "segmentation": True, "size": SIZE, "open_renderer": RayCaster}
    render_candidates(CandidateImageSettings(path, **settings | changes))
    with pytest.raises(DatasetError) as error:
        KeyframeSamples(CONFIG, tmp_path, "train")
    assert (error.value.where, error.value.found) == (tmp_path / "candidates_images.h5", found)


@pytest.mark.parametrize("pose", ["intrinsic", "camera_in_base"])
def test_missing_calibration_is_an_error(folder, tmp_path, pose):
    for name in ("candidates.h5", "candidates_images.h5"):
        shutil.copy(folder / name, tmp_path)
    with h5py.File(tmp_path / "candidates_images.h5", "r+") as file:
        del file[f"static_camera/{pose}"]
    with pytest.raises(DatasetError) as error:
        KeyframeSamples(CONFIG, tmp_path, "train")
    assert (error.value.where, error.value.found) == (tmp_path / "candidates_images.h5", f"no static_camera/{pose}")


def test_files_with_other_cameras_are_an_error(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "a")
    (tmp_path / "b").mkdir()
    path = write_candidates_of(tmp_path / "b" / "candidates.h5", (7, 8))
    cameras = ("static_camera", "gripper_camera")
    settings = {"views": 2, "segmentation": True, "size": SIZE, "cameras": cameras, "open_renderer": RayCaster}
    render_candidates(CandidateImageSettings(path, **settings))
    with pytest.raises(DatasetError) as error:
        KeyframeSamples(CONFIG, tmp_path, "train")
    assert "base_camera" in error.value.expected and "base_camera" not in error.value.found


def test_missing_files_are_an_error(folder, tmp_path):
    with pytest.raises(DatasetError) as error:
        KeyframeSamples(CONFIG, tmp_path, "train")
    assert error.value.where == tmp_path
    shutil.copy(folder / "candidates.h5", tmp_path)  # without images
    with pytest.raises(DatasetError) as error:
        KeyframeSamples(CONFIG, tmp_path, "train")
    assert error.value.where == tmp_path / "candidates_images.h5"


@pytest.mark.parametrize(
    "values",
    [
        {"crop_scale": (1.5, 0.75)},
        {"crop_scale": (-1.0, 0.0)},
        {"channels": (0, 8, 8, 8, 8)},
        {"crop_size": (100, 64)},
        {"decisions": {"view_distances": ()}},
    ],
)
def test_invalid_settings_are_refused(values):
    with pytest.raises(ValidationError):
        KeyframeConfig(**values)
