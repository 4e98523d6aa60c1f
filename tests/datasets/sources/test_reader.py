"""What a dataset says of itself, whichever way it is asked."""

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


def lerobot(root):
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text("{}")


def datasets(root):
    for name in ("part_1", "part_0"):
        (root / name).mkdir(parents=True)
        (root / name / "conversion.json").write_text("{}")


def plan(root):
    datasets(root / "datasets")


def recording(root):
    root.mkdir()
    (root / "trajectory.h5").touch()


@pytest.mark.parametrize("ask", [Dataset, validate])
def test_what_takes_robocas_folders_says_what_else_lies_there(tmp_path, ask):
    lerobot(tmp_path / "here")
    with pytest.raises(DatasetError, match="here: a LeRobot dataset; this takes RoboCAS folders$"):
        ask(tmp_path / "here")


def test_a_lerobot_dataset_is_counted_as_one(tmp_path):
    lerobot(tmp_path / "here")
    with pytest.raises(DatasetError, match="codebase_version"):
        collect(tmp_path / "here")


@pytest.mark.parametrize("ask", [Dataset, collect, validate])
@pytest.mark.parametrize(
    ("make", "said"),
    [
        (datasets, "here: no dataset here .*Did you mean .*here/part_0[?]$"),
        (plan, "here: no dataset here .*Did you mean .*here/datasets/part_0[?]$"),
        (recording, "here: no dataset here .*Did you mean .*here/trajectory.h5[?]$"),
    ],
)
def test_what_may_have_been_meant(tmp_path, ask, make, said):
    make(tmp_path / "here")
    with pytest.raises(DatasetError, match=said):
        ask(tmp_path / "here")
