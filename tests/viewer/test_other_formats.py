"""Formats of other packages on the page, by what an `EpisodeSource` has and nothing else."""

import numpy as np
import pytest

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import formats
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.viewer.images import decode
from robocas_ms3.viewer.routes import Routes
from robocas_ms3.viewer.source import open_source

SOURCE = ("rate_hz", "numbers", "lengths", "cameras", "has_depth", "has_embeddings", "split", "entry", "action_space")
EPISODE = ("where", "steps", "instruction", "arrays", "read", "goals", "scene", "layout", "cameras", "rgb", "depth")


class Episode:
    """Of the protocol only, whatever the other one has."""

    def __init__(self, other):
        self._other = other

    def __getattr__(self, name):
        if name not in EPISODE:
            raise AttributeError(name)
        return getattr(self._other, name)


class Source:
    def __init__(self, folder, broken=()):
        self.root, self._dataset, self._broken = folder, Dataset(folder), broken

    def __getattr__(self, name):
        if name in self._broken:
            raise DatasetError("damaged", where=name)
        if name not in SOURCE:
            raise AttributeError(name)
        return getattr(self._dataset, name)

    def episode(self, number):
        return Episode(self._dataset.episode(number))


@pytest.fixture
def page(folder, monkeypatch):
    """Opens the folder as a format of its own."""

    def opened(*broken):
        def read(path, *, rate_hz=None, include_failed=False):
            return Source(path, broken)

        toy = formats.Format("toy", "toy dataset", lambda path: path == folder, "toys:read")
        monkeypatch.setattr(formats.Format, "part", lambda self, name: read)
        monkeypatch.setattr(formats, "FORMATS", {"toy": toy})
        return open_source(folder)

    yield opened


@pytest.fixture
def known(folder):
    return open_source(folder)


def test_it_lists_what_its_source_knows(page, known):
    index, wanted = page().index(), known.index()
    assert index["kind"] == "toy dataset"
    assert index["episodes"] == wanted["episodes"]
    assert {key: index[key] for key in index if key != "kind"} == {key: wanted[key] for key in wanted if key != "kind"}


def test_an_episode_is_shown_by_its_arrays(page, known, folder):
    assert page().episode(1) == known.episode(1)
    picture, stored = page().rgb(1, "base_camera", 2), Dataset(folder).episode(1)
    assert picture.media_type == "image/jpeg"
    assert np.abs(decode(picture).astype(float) - stored.rgb("base_camera", 2)).mean() < 6
    assert (page().depth(1, "base_camera", 2) == stored.depth("base_camera", 2)).all()


def test_what_is_damaged_is_left_out(page, known):
    index = page("lengths", "split", "entry").index()
    (row, *_), (wanted, *_) = index["episodes"], known.index()["episodes"]
    assert row["damage"] == "conversion.json: damaged"
    assert {**row, "damage": ""} == {**wanted, "split": ""}


def test_there_is_no_such_episode(page):
    for address in ("/data/episode_9.js", "/pictures/9/base_camera/rgb/0.jpg", "/pictures/0/base_camera/rgb/9.jpg"):
        assert Routes(page()).respond(address).status == 404
