from __future__ import annotations

import shutil

import pytest
from lerobot_folders import convert

from robocas_ms3.datasets.lerobot.variants import VARIANTS


@pytest.fixture(scope="session")
def versions(trajectory, tmp_path_factory):
    """A dataset of three episodes per version, the second one failed; for reading only."""
    root = tmp_path_factory.mktemp("versions")
    for version in VARIANTS:
        convert(trajectory, root / version, include_failed=True, lerobot_version=version)
    return root


@pytest.fixture(scope="session")
def valid(trajectory, tmp_path_factory):
    """A dataset of version 0.5 of two episodes with one camera, for reading only."""
    out = tmp_path_factory.mktemp("checked") / "dataset"
    convert(trajectory, out, cameras=("base_camera",), lerobot_version="0.5")
    return out


@pytest.fixture
def spoiled(valid, tmp_path):
    """A copy of `valid` that a test may change."""
    return shutil.copytree(valid, tmp_path / "spoiled")
