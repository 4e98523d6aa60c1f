"""A made-up baseline, and a small dataset for real ones."""

import os
from dataclasses import replace

import pytest
from short_protocols import shorten
from stub_baseline import MADE_UP
from synthetic_dataset import synthetic_dataset
from training_runs import train

from robocas_ms3.baselines.registry import BASELINES
from robocas_ms3.cli.train import COMMANDS, PluginBaseline, command


@pytest.fixture
def made_up(monkeypatch):
    """A function that changes the made-up baseline, which is registered."""

    def change(**values):
        monkeypatch.setitem(BASELINES.builtin, "made-up", lambda: replace(MADE_UP, **values))

    change()
    monkeypatch.setitem(COMMANDS, "made-up", command("made-up", PluginBaseline))
    return change


@pytest.fixture(scope="session")
def short(tmp_path_factory):
    """A protocol: three episodes of paper-v1, 60 steps each."""
    return str(shorten("paper-v1", tmp_path_factory.mktemp("protocol") / "short", 60, episodes=3))


@pytest.fixture
def data(tmp_path):
    path = tmp_path / "data.h5"
    path.write_text("demonstrations")
    return path


@pytest.fixture
def usual_umask():
    before = os.umask(0o022)
    yield
    os.umask(before)


@pytest.fixture
def whole(usual_umask, made_up, data, tmp_path):
    train("made-up", data, tmp_path / "whole")
    return tmp_path / "whole"


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A dataset of six episodes of seven steps, 64 x 48 images, that nobody may change; five are to train on."""
    return synthetic_dataset(tmp_path_factory.mktemp("baselines"))
