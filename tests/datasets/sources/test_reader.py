"""What a dataset says of itself, whichever way it is asked."""

import json

import pytest

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.statistics.collect import collect


class Listed(list):
    """Numbers that nobody may search through."""

    def __contains__(self, number):
        raise AssertionError("a search through the list")


def test_an_episode_is_found_without_a_search(tmp_path):
    """All of 10 000 episodes are opened in turn."""
    for number in (0, 3):
        (tmp_path / f"episode_{number:07d}").mkdir()
    dataset = Dataset(tmp_path)
    dataset.__dict__["numbers"] = Listed(dataset.numbers)
    assert dataset.episode(3).folder.name == "episode_0000003"
    with pytest.raises(DatasetError, match="no such episode .expected 0 to 3, found 2"):
        dataset.episode(2)


def test_a_dataset_without_a_split(tmp_path):
    (tmp_path / "episode_0000000").mkdir()
    assert Dataset(tmp_path).sides == ([], [])


@pytest.mark.parametrize("key", ["ep_length", "train_eps", "val_eps"])
def test_an_overview_that_lacks_a_key_is_damaged_and_not_empty(tmp_path, key):
    (tmp_path / "episode_0000000").mkdir()
    info = {"ep_length": {"0": 7}, "train_eps": [0], "val_eps": []}
    (tmp_path / "data_info.json").write_text(json.dumps({name: info[name] for name in info if name != key}))
    with pytest.raises(DatasetError) as error:
        Dataset(tmp_path).split("all")
    assert (error.value.where, error.value.expected) == (tmp_path / "data_info.json", key)


@pytest.mark.parametrize("ask", [Dataset, collect, validate])
@pytest.mark.parametrize(
    ("file", "meant"),
    [
        ("part_0/conversion.json", "part_0"),
        ("datasets/part_0/conversion.json", "datasets/part_0"),
        ("trajectory.h5", "trajectory.h5"),
        ("meta/info.json", ""),
    ],
)
def test_what_may_have_been_meant(tmp_path, ask, file, meant):
    (tmp_path / "here" / file).parent.mkdir(parents=True)
    (tmp_path / "here" / file).write_text("{}")
    with pytest.raises(DatasetError) as error:
        ask(tmp_path / "here")
    assert not meant or f"Did you mean {tmp_path / 'here' / meant}?" in str(error.value)
