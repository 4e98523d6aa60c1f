from __future__ import annotations

import shutil

import pytest
from lerobot_folders import convert


@pytest.fixture(scope="module")
def lerobot(trajectory, tmp_path_factory):
    """A dataset of two episodes, for reading only."""
    out = tmp_path_factory.mktemp("lerobot") / "dataset"
    convert(trajectory, out)
    return out


@pytest.fixture(scope="module")
def valid(trajectory, tmp_path_factory):
    """A dataset of version 0.5 with one camera, for reading only."""
    out = tmp_path_factory.mktemp("checked") / "dataset"
    convert(trajectory, out, cameras=("base_camera",), lerobot_version="0.5")
    return out


@pytest.fixture
def spoiled(valid, tmp_path):
    """A copy of `valid` that a test may change."""
    return shutil.copytree(valid, tmp_path / "spoiled")
