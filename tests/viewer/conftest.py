"""Datasets for the viewer, without a simulator."""

from __future__ import annotations

import json

import pytest
from synthetic import RayCaster, write_trajectory


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory):
    """A run of three episodes: seed 4 failed once before, seed 9 was skipped."""
    folder = tmp_path_factory.mktemp("run")
    path = write_trajectory(folder / "trajectory.h5", seeds=(3, 4, 5), failed=(1,))
    metadata = json.loads(path.with_suffix(".json").read_text())
    metadata["episodes"][1]["robocas"]["attempts"] = 2
    path.with_suffix(".json").write_text(json.dumps(metadata))
    failures = [
        {"seed": 4, "attempt": 0, "stage": "grasp", "reason": "slipped", "seconds": 2.5},
        {"seed": 9, "attempt": 0, "stage": "reach", "reason": "unreachable", "seconds": 1.0},
        {"seed": 9, "attempt": -1, "stage": "episode", "reason": "skipped", "seconds": 0.0},
    ]
    (folder / "failures.jsonl").write_text("".join(json.dumps(line) + "\n" for line in failures))
    return folder


@pytest.fixture(scope="session")
def folder(run_folder, tmp_path_factory):
    """The run as a RoboCAS folder with all three episodes and small images, for reading only."""
    from robocas_ms3.datasets.conversion.convert import convert
    from robocas_ms3.datasets.conversion.settings import ConversionSettings

    out = tmp_path_factory.mktemp("folder") / "dataset"
    settings = {"open_renderer": RayCaster, "embeddings": False, "video": False, "include_failed": True}
    convert(ConversionSettings(run_folder / "trajectory.h5", out, **settings))
    (out / "failures.jsonl").write_bytes((run_folder / "failures.jsonl").read_bytes())
    return out


@pytest.fixture(scope="session")
def lerobot(folder, tmp_path_factory):
    """The folder as a LeRobot dataset."""
    pytest.importorskip("av", reason="needs the extra 'lerobot'")
    pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")
    from robocas_ms3.datasets.conversion.settings import ConversionSettings
    from robocas_ms3.datasets.lerobot.convert import convert_lerobot

    out = tmp_path_factory.mktemp("lerobot") / "dataset"
    convert_lerobot(ConversionSettings(folder, out, include_failed=True))
    (out / "failures.jsonl").write_bytes((folder / "failures.jsonl").read_bytes())
    return out
