"""Datasets of other formats have the same page as their RoboCAS folder."""

import json
import shutil

import numpy as np
import pytest

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import formats
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.viewer.images import decode_image
from robocas_ms3.viewer.routes import Routes
from robocas_ms3.viewer.source import open_content

MAX_DEPTH_MM = 4095  # of LeRobot's depth videos
SOURCE = (
    "rate_hz",
    "numbers",
    "lengths",
    "cameras",
    "has_depth",
    "has_embeddings",
    "split",
    "conversion_entry",
    "action_space",
)
EPISODE = ("where", "steps", "instruction", "arrays", "read", "goals", "scene", "layout", "cameras", "rgb", "depth")


class PartialCopy:
    """Copies some attributes of an object and damages others."""

    def __init__(self, other, names, broken=(), **own):
        self.__dict__.update(own, _other=other, _names=names, _broken=broken)

    def __getattr__(self, name):
        if name in self._broken:
            raise DatasetError("damaged", where=name)
        if name not in self._names:
            raise AttributeError(name)
        return getattr(self._other, name)


def open_toy(folder, monkeypatch, broken=()):
    """Open a folder as a format of another package, with the interface of `EpisodeSource` only."""

    def read(path, *, rate_hz=None, include_failed=False):
        dataset = Dataset(path)
        episode = lambda number: PartialCopy(dataset.episode(number), EPISODE)  # noqa: E731
        return PartialCopy(dataset, SOURCE, broken, root=path, episode=episode)

    toy = formats.Format("toy", "toy dataset", lambda path: path == folder, "toys:read")
    with monkeypatch.context() as patch:
        patch.setattr(formats.Format, "import_function", lambda self, name: read)
        patch.setattr(formats, "FORMATS", {"toy": toy})
        return open_content(folder)


@pytest.fixture(params=["LeRobot dataset", "toy dataset"])
def page(request, folder, monkeypatch):
    toy = request.param == "toy dataset"
    opened = open_toy(folder, monkeypatch) if toy else open_content(request.getfixturevalue("lerobot"))
    assert opened.index()["kind"] == request.param
    return opened


def test_table_equals_that_of_the_folder(page, folder):
    index, wanted = page.index(), open_content(folder).index()
    for key in wanted.keys() - {"kind", "name"}:
        assert index[key] == wanted[key], key


def test_episode_equals_that_of_the_folder(page, folder):
    episode, wanted = page.episode(1), open_content(folder).episode(1)
    for key in ("instruction", "steps", "times", "subgoals", "facts", "failures"):
        assert episode[key] == wanted[key], key
    for mine, theirs in zip(episode["plots"], wanted["plots"], strict=True):
        assert mine["title"] == theirs["title"]
        values = [np.array([s["values"] for s in p["series"]]) for p in (mine, theirs)]
        np.testing.assert_allclose(*values, atol=2e-2 if "deg" in mine["unit"] else 1e-3)
    np.testing.assert_allclose(episode["trace"]["tcp"], wanted["trace"]["tcp"], atol=1e-5)


def test_images_belong_to_the_requested_step(page, folder):
    episode = Dataset(folder).episode(1)
    for step in (0, 3, 6):
        shown = page.rgb(1, "static_camera", step)
        assert shown.media_type == "image/jpeg"
        stored = episode.rgb("static_camera", step)
        assert np.abs(decode_image(shown).astype(float) - stored).mean() < 12  # video and JPEG lose a little
        depth = episode.depth("static_camera", step).clip(max=MAX_DEPTH_MM)
        np.testing.assert_array_equal(page.depth(1, "static_camera", step).clip(max=MAX_DEPTH_MM), depth)


def test_unknown_episode_or_step(page):
    for address in ("/data/episode_9.js", "/images/9/base_camera/rgb/0.jpg", "/images/0/base_camera/rgb/9.jpg"):
        assert Routes(page).respond(address).status == 404


def test_damaged_values_of_a_source_are_omitted(folder, monkeypatch):
    index = open_toy(folder, monkeypatch, ("lengths", "split", "conversion_entry")).index()
    (row, *_), (wanted, *_) = index["episodes"], open_content(folder).index()["episodes"]
    assert row["damage"] == "conversion.json: damaged"
    assert {**row, "damage": ""} == {**wanted, "split": ""}


def test_the_memory_of_decoded_images_is_bounded(lerobot, monkeypatch):
    from robocas_ms3.datasets.lerobot.reader import LeRobotEpisode

    decoded, frames = [], LeRobotEpisode.frames
    monkeypatch.setattr(LeRobotEpisode, "frames", lambda self, *key: decoded.append(self.number) or frames(self, *key))
    monkeypatch.setattr("robocas_ms3.viewer.source._CACHE_BYTES", 2 * 7 * 64 * 48 * 3)  # two episodes of a camera
    source = open_content(lerobot)
    for number in (0, 1, 0, 2, 0, 1):
        source.rgb(number, "base_camera", 3)
    assert decoded == [0, 1, 2, 1]


def test_other_lerobot_dataset_shows_its_columns(lerobot, tmp_path):
    other = shutil.copytree(lerobot, tmp_path / "other")
    shutil.rmtree(other / "meta/robocas")
    info = json.loads((other / "meta/info.json").read_text())
    del info["features"]["observation.arm_base"]
    (other / "meta/info.json").write_text(json.dumps(info))
    source = open_content(other)
    (row, *_) = source.index()["episodes"]
    assert (row["steps"], row["success"]) == (7, None)
    assert row["instruction"] == "grasp the cube 3 on the table and move it to the basket"
    episode = source.episode(0)
    plots = {plot["title"]: [series["name"] for series in plot["series"]] for plot in episode["plots"]}
    assert plots["action"][-1] == "gripper_open"
    assert "observation.state" in plots
    assert "timestamp" not in plots
    assert episode["trace"] is None
