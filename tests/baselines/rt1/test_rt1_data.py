"""Samples of rt1, and refused configurations."""

import json

import numpy as np
import pytest
import torch
from rt1_sizes import SIZES

from robocas_ms3.baselines.rt1 import BASELINE
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.core.errors import TrainingError
from robocas_ms3.core.strict_model import parse
from robocas_ms3.datasets.formats import open_source


def read(folder, split="train", **changes):
    return BASELINE.data(RT1Config(**{**SIZES, **changes}), folder, split, lambda done, total: None)


@pytest.fixture(scope="module")
def samples(folder):
    return read(folder)


def test_batch(samples, folder):
    """Episodes of seven steps have six actions; the last action is terminal."""
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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"crop_height": 300}, "crop_height 300"),
        ({"cameras": ["base_camera", "base_camera"]}, "cameras"),
        ({"cameras": []}, "cameras"),
        ({"image_size": [16, 256]}, "32 pixels"),
        ({"image_std": [0.2, 0.0, 0.2]}, "image_std"),
        ({"bins": 1}, "bins"),
        ({"layer": 3}, "layers"),
    ],
)
def test_invalid_configurations_are_one_line_errors(changes, message):
    with pytest.raises(TrainingError, match=message) as caught:
        parse(RT1Config, changes, TrainingError, where="rt1")
    assert "\n" not in str(caught.value)
