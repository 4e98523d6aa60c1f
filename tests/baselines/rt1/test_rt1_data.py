"""Samples of rt1, and datasets that it can't be trained on."""

import json
import shutil

import numpy as np
import pytest
import torch
from made_up_runs import assert_same, stop_at, train
from rt1_sizes import SIZES
from torch.utils.data import DataLoader

from robocas_ms3.baselines.rt1 import BASELINE
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.rt1.policy import scaled
from robocas_ms3.core.errors import DatasetError, TrainingError
from robocas_ms3.core.strict import parse
from robocas_ms3.datasets.formats import open_source


@pytest.fixture(scope="module")
def samples(folder):
    return BASELINE.data(RT1Config(**SIZES), folder, "train", lambda done, of: None)


def test_a_batch(samples, folder):
    """Episodes of seven steps: six actions, the last of which ends it."""
    assert (len(samples), samples.episodes) == (30, 5)
    batch = samples.__getitems__([0, 5, 10])  # steps 0 and 5 of the first episode, 4 of the second
    assert batch["rgb"].shape == (3, 6, 2, 3, 48, 64)
    assert batch["rgb"].dtype == torch.uint8
    assert (batch["language"].shape, batch["language"].dtype) == ((3, 384), torch.float32)
    assert (batch["action"].shape, batch["action"].dtype) == ((3, 6, 7), torch.float32)
    assert batch["mask"].int().tolist() == [[0, 0, 0, 0, 0, 1], [1] * 6, [0, 1, 1, 1, 1, 1]]
    assert batch["terminate"].int().tolist() == [[0] * 6, [0, 0, 0, 0, 0, 1], [0] * 6]
    assert torch.equal(batch["rgb"][0, 0], batch["rgb"][0, 5])  # the first picture, repeated
    assert torch.equal(batch["rgb"][0, 5], batch["rgb"][1, 0])
    source = open_source(folder)
    episode = source.episode(source.split("train")[0])
    assert torch.equal(batch["rgb"][1, 4, 1].permute(1, 2, 0), torch.from_numpy(episode.rgb("gripper_camera", 4)))
    arrays = episode.read(["rel_pos", "gripper_status", "language_embedding"])
    assert torch.equal(batch["language"][1], torch.from_numpy(arrays["language_embedding"]))
    assert np.allclose(batch["action"][1, :, :3], arrays["rel_pos"][:6])
    assert np.allclose(batch["action"][1, :, 6], arrays["gripper_status"].reshape(-1)[1:7])


def test_more_than_one_action_may_be_told_as_the_end(folder):
    samples = BASELINE.data(RT1Config(**SIZES, terminate_steps=2), folder, "train", lambda done, of: None)
    assert samples.__getitems__([5])["terminate"].int().tolist() == [[0, 0, 0, 0, 1, 1]]
    assert samples.__getitems__([4])["terminate"].int().tolist() == [[0, 0, 0, 0, 0, 1]]


def test_facts(samples, folder):
    info = json.loads((folder / "data_info.json").read_text())["action_space"]
    assert samples.facts == {
        "rate_hz": 5.0,
        "cameras": {"base_camera": [64, 48], "gripper_camera": [64, 48]},
        "action_low": [*info["relative_position"][0], *info["relative_rotation"][0]],
        "action_high": [*info["relative_position"][1], *info["relative_rotation"][1]],
    }
    assert json.loads(json.dumps(samples.facts)) == samples.facts


def test_workers_read_the_same(samples):
    loader = DataLoader(samples, batch_size=3, num_workers=1, collate_fn=lambda batch: batch)
    first = next(iter(loader))
    assert all(torch.equal(value, first[name]) for name, value in samples.__getitems__([0, 1, 2]).items())


@pytest.mark.parametrize("size", [(40, 34), (80, 60), (64, 48), (80, 40)])
def test_policies_scale_pictures_as_samples_are_scaled(folder, size):
    samples = BASELINE.data(
        RT1Config(**{**SIZES, "picture": size, "crop_height": 32}), folder, "train", lambda done, of: None
    )
    source = open_source(folder)
    shot = source.episode(source.split("train")[0]).rgb("base_camera", 0)
    assert shot.shape == (48, 64, 3)
    assert np.array_equal(samples.__getitems__([0])["rgb"][0, 0, 0].permute(1, 2, 0), scaled(shot, size))


def test_validation_has_episodes_of_its_own(folder):
    assert BASELINE.data(RT1Config(**SIZES), folder, "val", lambda done, of: None).episodes == 1


def changed(folder, tmp_path, **settings):
    copy = shutil.copytree(folder, tmp_path / "dataset")
    path = copy / "conversion.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **settings}))
    return copy


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"embeddings": False}, "rt1 needs embeddings of the instructions"),
        ({"cameras": ["base_camera"]}, "expected base_camera, gripper_camera, found base_camera"),
        ({"cameras": []}, "expected base_camera, gripper_camera, found none"),
        ({"rate_hz": 10.0}, "expected 5 Hz, found 10 Hz"),
    ],
)
def test_other_datasets_are_refused_in_a_line(settings, said, folder, tmp_path):
    copy = changed(folder, tmp_path, **settings)
    with pytest.raises(DatasetError, match=said) as caught:
        BASELINE.data(RT1Config(**SIZES), copy, "train", lambda done, of: None)
    assert "\n" not in str(caught.value)
    assert str(copy) in str(caught.value)


def test_another_rate_may_be_asked_for(folder, tmp_path):
    copy = changed(folder, tmp_path, rate_hz=10.0)
    assert (
        BASELINE.data(RT1Config(**SIZES, rate_hz=10.0), copy, "train", lambda done, of: None).facts["rate_hz"] == 10.0
    )


def test_no_validation_is_said_as_trainers_expect_it(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "dataset")
    path = copy / "data_info.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "val_eps": []}))
    with pytest.raises(DatasetError, match="split holds no episodes"):
        BASELINE.data(RT1Config(**SIZES), copy, "val", lambda done, of: None)


@pytest.mark.parametrize("key", ["rel_pos", "language_embedding"])
def test_nan_in_data_is_named(key, folder, tmp_path):
    """Before the first step."""
    copy = shutil.copytree(folder, tmp_path / "dataset")
    number = open_source(copy).split("train")[-1]
    path = copy / f"episode_{number:07d}" / "episode_info.npz"
    arrays = dict(np.load(path))
    arrays[key][0] = np.nan
    np.savez(path, **arrays)
    with pytest.raises(DatasetError, match=f"episode {number}, {key}: not a number"):
        BASELINE.data(RT1Config(**SIZES), copy, "train", lambda done, of: None)


def test_it_goes_on_to_the_bit(folder, tmp_path):
    """With what is random in it: crops and dropout."""
    few = {"steps": 4, "batch_size": 2, "save_every": 2, "log_every": 1, "workers": 0}
    changes = {**RT1Config(**SIZES).model_dump(), "train": few}
    train("rt1", folder, tmp_path / "whole", changes)
    with pytest.raises(RuntimeError):
        train("rt1", folder, tmp_path / "again", changes, progress=stop_at(3, RuntimeError("gone")))
    train("rt1", folder, tmp_path / "again")
    assert_same(tmp_path / "whole", tmp_path / "again")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"crop_height": 300}, "crop_height 300 is more than the picture's 256 rows"),
        ({"cameras": ["base_camera", "base_camera"]}, "each once"),
        ({"cameras": []}, "each once"),
        ({"picture": [16, 256]}, "at least 32 pixels"),
        ({"image_std": [0.2, 0.0, 0.2]}, "above 0"),
        ({"bins": 1}, "bins"),
        ({"layer": 3}, "Did you mean layers"),
    ],
)
def test_wrong_configurations_are_a_line(changes, said):
    with pytest.raises(TrainingError, match=said) as caught:
        parse(RT1Config, changes, TrainingError, where="rt1")
    assert "\n" not in str(caught.value)
