"""A registered stub baseline, and a small dataset for real baselines."""

import os
from dataclasses import replace

import pytest
from short_protocols import shorten
from stub_baseline import STUB
from synthetic_dataset import synthetic_dataset
from training_runs import train

from robocas_ms3.baselines.registry import BASELINES
from robocas_ms3.cli.train import COMMANDS, PluginBaseline, command


@pytest.fixture
def stub(monkeypatch):
    """Register the stub baseline; return a function that changes it."""

    def change(**values):
        monkeypatch.setitem(BASELINES.builtin, "stub", lambda: replace(STUB, **values))

    change()
    monkeypatch.setitem(COMMANDS, "stub", command("stub", PluginBaseline))
    return change


@pytest.fixture(scope="session")
def short(tmp_path_factory):
    """Return a protocol with three episodes of paper-v1, 60 steps each."""
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
def whole(usual_umask, stub, data, tmp_path):
    train("stub", data, tmp_path / "whole")
    return tmp_path / "whole"


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Return a read-only dataset of six episodes of seven steps, 64 x 48 images; five are in the training split."""
    return synthetic_dataset(tmp_path_factory.mktemp("baselines"))
