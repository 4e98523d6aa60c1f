"""Samples of rt1, datasets and configurations that it refuses, and that a run continues to the bit."""

import json
import shutil

import numpy as np
import pytest
import torch
from made_up_runs import assert_same, stop_at, train
from rt1_sizes import SIZES

from robocas_ms3.baselines.rt1 import BASELINE
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.rt1.policy import scale_image
from robocas_ms3.core.errors import DatasetError, EmptySplitError, TrainingError
from robocas_ms3.core.strict import parse
from robocas_ms3.datasets.formats import open_source


def read(folder, split="train", **changes):
    return BASELINE.data(RT1Config(**{**SIZES, **changes}), folder, split, lambda done, total: None)


@pytest.fixture(scope="module")
def samples(folder):
    return read(folder)


def test_a_batch(samples, folder):
    """Episodes of seven steps: six actions, the last of which ends it."""
    assert (len(samples), samples.episodes, read(folder, "val").episodes) == (30, 5, 1)
    batch = samples.__getitems__([0, 5, 10])  # steps 0 and 5 of the first episode, 4 of the second
    assert batch["rgb"].shape == (3, 6, 2, 3, 48, 64)
    assert batch["rgb"].dtype == torch.uint8
    assert (batch["language"].shape, batch["language"].dtype) == ((3, 384), torch.float32)
    assert (batch["action"].shape, batch["action"].dtype) == ((3, 6, 7), torch.float32)
    assert batch["mask"].int().tolist() == [[0, 0, 0, 0, 0, 1], [1] * 6, [0, 1, 1, 1, 1, 1]]
    assert batch["terminate"].int().tolist() == [[0] * 6, [0, 0, 0, 0, 0, 1], [0] * 6]
    assert read(folder, terminate_steps=2).__getitems__([5])["terminate"].int().tolist() == [[0, 0, 0, 0, 1, 1]]
    assert torch.equal(batch["rgb"][0, 0], batch["rgb"][0, 5])  # the first image, repeated
    assert torch.equal(batch["rgb"][0, 5], batch["rgb"][1, 0])
    source = open_source(folder)
    episode = source.episode(source.split("train")[0])
    assert torch.equal(batch["rgb"][1, 4, 1].permute(1, 2, 0), torch.from_numpy(episode.rgb("gripper_camera", 4)))
    arrays = episode.read(["rel_pos", "gripper_status", "language_embedding"])
    assert torch.equal(batch["language"][1], torch.from_numpy(arrays["language_embedding"]))
    assert np.allclose(batch["action"][1, :, :3], arrays["rel_pos"][:6])
    assert np.allclose(batch["action"][1, :, 6], arrays["gripper_status"].reshape(-1)[1:7])


def test_facts(samples, folder):
    info = json.loads((folder / "data_info.json").read_text())["action_space"]
    assert json.loads(json.dumps(samples.facts)) == {
        "rate_hz": 5.0,
        "cameras": {"base_camera": [64, 48], "gripper_camera": [64, 48]},
        "action_low": [*info["relative_position"][0], *info["relative_rotation"][0]],
        "action_high": [*info["relative_position"][1], *info["relative_rotation"][1]],
    }


@pytest.mark.parametrize("size", [(40, 34), (80, 60), (64, 48), (80, 40)])
def test_policies_scale_images_as_samples_are_scaled(folder, size):
    source = open_source(folder)
    image = source.episode(source.split("train")[0]).rgb("base_camera", 0)
    scaled = read(folder, picture=size, crop_height=32).__getitems__([0])["rgb"][0, 0, 0].permute(1, 2, 0)
    assert np.array_equal(scaled, scale_image(image, size))


def change(folder, tmp_path, name="conversion.json", **settings):
    copy = shutil.copytree(folder, tmp_path / "dataset")
    path = copy / name
    path.write_text(json.dumps({**json.loads(path.read_text()), **settings}))
    return copy


@pytest.mark.parametrize("settings", [{"embeddings": False}, {"cameras": ["base_camera"]}, {"cameras": []}])
def test_datasets_that_do_not_suit(settings, folder, tmp_path):
    copy = change(folder, tmp_path, **settings)
    with pytest.raises(DatasetError) as caught:
        read(copy)
    assert caught.value.where == copy and "\n" not in str(caught.value)


def test_a_dataset_of_another_rate_needs_an_option(folder, tmp_path):
    copy = change(folder, tmp_path, rate_hz=10.0)
    with pytest.raises(DatasetError):
        read(copy)
    assert read(copy, rate_hz=10.0).facts["rate_hz"] == 10.0


def test_a_split_without_episodes(folder, tmp_path):
    with pytest.raises(EmptySplitError):
        read(change(folder, tmp_path, "data_info.json", val_eps=[]), "val")


@pytest.mark.parametrize("key", ["rel_pos", "language_embedding"])
def test_nan_is_found_before_the_first_step(key, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "dataset")
    number = open_source(copy).split("train")[-1]
    path = copy / f"episode_{number:07d}" / "episode_info.npz"
    arrays = dict(np.load(path))
    arrays[key][0] = np.nan
    np.savez(path, **arrays)
    with pytest.raises(DatasetError, match=f"episode {number}, {key}: "):
        read(copy)


def test_a_run_continues_to_the_bit(folder, tmp_path):
    """With all that is random: crops and dropout."""
    few = {"steps": 4, "batch_size": 2, "save_every": 2, "log_every": 1, "workers": 0}
    changes = {**RT1Config(**SIZES).model_dump(), "train": few}
    train("rt1", folder, tmp_path / "whole", changes)
    with pytest.raises(RuntimeError):
        train("rt1", folder, tmp_path / "again", changes, progress=stop_at(3, RuntimeError("gone")))
    train("rt1", folder, tmp_path / "again")
    assert_same(tmp_path / "whole", tmp_path / "again")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"crop_height": 300}, "crop_height 300"),
        ({"cameras": ["base_camera", "base_camera"]}, "cameras"),
        ({"cameras": []}, "cameras"),
        ({"picture": [16, 256]}, "32 pixels"),
        ({"image_std": [0.2, 0.0, 0.2]}, "image_std"),
        ({"bins": 1}, "bins"),
        ({"layer": 3}, "layers"),
    ],
)
def test_invalid_configurations_are_one_line(changes, message):
    with pytest.raises(TrainingError, match=message) as caught:
        parse(RT1Config, changes, TrainingError, where="rt1")
    assert "\n" not in str(caught.value)
