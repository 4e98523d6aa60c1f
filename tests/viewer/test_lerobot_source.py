"""LeRobot datasets on the page: ours say as much as the folder they came from, others show their columns."""

import json
import shutil

import numpy as np
import pytest

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.lerobot.reader import LeRobotEpisode
from robocas_ms3.datasets.lerobot.schema import MAX_DEPTH_MM
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.viewer.images import decode
from robocas_ms3.viewer.source import open_source


def test_ours_lists_what_the_folder_lists(lerobot, folder):
    index, wanted = open_source(lerobot).index(), open_source(folder).index()
    assert index["episodes"] == wanted["episodes"]
    assert (index["cameras"], index["depth"], index["rate_hz"]) == (wanted["cameras"], True, 5)


def test_ours_shows_what_the_folder_shows(lerobot, folder):
    episode, wanted = open_source(lerobot).episode(2), open_source(folder).episode(2)
    for key in ("instruction", "steps", "times", "subgoals", "facts"):
        assert episode[key] == wanted[key]
    for mine, theirs in zip(episode["plots"], wanted["plots"], strict=True):
        assert mine["title"] == theirs["title"]
        values = [np.array([s["values"] for s in p["series"]]) for p in (mine, theirs)]
        np.testing.assert_allclose(*values, atol=2e-2 if "deg" in mine["unit"] else 1e-3)
    np.testing.assert_allclose(episode["trace"]["tcp"], wanted["trace"]["tcp"], atol=1e-5)


def test_pictures_are_those_of_that_step(lerobot, folder):
    source, episode = open_source(lerobot), Dataset(folder).episode(1)
    for step in (0, 3, 6):
        shown = decode(source.rgb(1, "static_camera", step)).astype(float)
        assert np.abs(shown - episode.rgb("static_camera", step)).mean() < 12  # video and JPEG lose a little
        stored = np.minimum(episode.depth("static_camera", step), MAX_DEPTH_MM)
        assert (source.depth(1, "static_camera", step) == stored).all()
    for step in (7, 99):
        with pytest.raises(DatasetError, match="no such step"):
            source.rgb(1, "static_camera", step)
    with pytest.raises(DatasetError, match="no such episode"):
        source.rgb(3, "static_camera", 0)


def test_the_memory_of_decoded_images_is_bounded(lerobot, monkeypatch):
    decoded, frames = [], LeRobotEpisode.frames
    monkeypatch.setattr(LeRobotEpisode, "frames", lambda self, *key: decoded.append(self.number) or frames(self, *key))
    monkeypatch.setattr("robocas_ms3.viewer.source._CACHE_BYTES", 2 * 7 * 64 * 48 * 3)  # two episodes of a camera
    source = open_source(lerobot)
    for number in (0, 1, 0, 2, 0, 1):
        source.rgb(number, "base_camera", 3)
    assert decoded == [0, 1, 2, 1]


def test_another_makers_dataset_shows_its_columns(lerobot, tmp_path):
    other = shutil.copytree(lerobot, tmp_path / "other")
    shutil.rmtree(other / "meta/robocas")
    info = json.loads((other / "meta/info.json").read_text())
    del info["features"]["observation.arm_base"]
    (other / "meta/info.json").write_text(json.dumps(info))
    source = open_source(other)
    (row, *_) = source.index()["episodes"]
    assert (row["steps"], row["success"], row["instruction"]) == (
        7,
        None,
        "grasp the cube 3 on the table and move it to the basket",
    )
    episode = source.episode(0)
    assert {"observation.state", "action"} <= {plot["title"] for plot in episode["plots"]}
    (action,) = [plot for plot in episode["plots"] if plot["title"] == "action"]
    assert [series["name"] for series in action["series"]][-1] == "gripper_open"
    assert episode["trace"] is None
