"""Overview files of a dataset."""

import json

import pytest

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.statistics.collect import collect_statistics


def test_a_dataset_without_a_split(tmp_path):
    (tmp_path / "episode_0000000").mkdir()
    assert Dataset(tmp_path).splits == ([], [])


@pytest.mark.parametrize("key", ["ep_length", "train_eps", "val_eps"])
def test_missing_key_of_data_info_is_an_error(tmp_path, key):
    (tmp_path / "episode_0000000").mkdir()
    info = {"ep_length": {"0": 7}, "train_eps": [0], "val_eps": []}
    (tmp_path / "data_info.json").write_text(json.dumps({name: info[name] for name in info if name != key}))
    with pytest.raises(DatasetError) as error:
        Dataset(tmp_path).split("all")
    assert (error.value.where, error.value.expected) == (tmp_path / "data_info.json", key)


@pytest.mark.parametrize("ask", [Dataset, collect_statistics, validate])
@pytest.mark.parametrize(
    ("file", "meant"),
    [
        ("part_0/conversion.json", "part_0"),
        ("datasets/part_0/conversion.json", "datasets/part_0"),
        ("meta/info.json", ""),
    ],
)
def test_error_suggests_a_nearby_dataset(tmp_path, ask, file, meant):
    (tmp_path / "here" / file).parent.mkdir(parents=True)
    (tmp_path / "here" / file).write_text("{}")
    with pytest.raises(DatasetError) as error:
        ask(tmp_path / "here")
    assert not meant or f"Did you mean {tmp_path / 'here' / meant}?" in str(error.value)


def test_unknown_camera_is_wrong_usage(dataset):
    episode = Dataset(dataset).episode(0)
    for read in (episode.rgb, episode.depth):
        with pytest.raises(DatasetError) as error:
            read("base_cam", 0)
        assert (error.value.found, error.value.usage) == ("base_cam", True)
        assert episode.cameras and all(camera in error.value.expected for camera in episode.cameras)
