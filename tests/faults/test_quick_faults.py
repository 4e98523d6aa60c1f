"""Faults in the worker processes of a conversion and a generation, with made-up episodes: the quick set of the suite.

The same for plans is in tests/plans/test_run_plan.py, for evaluation in tests/evaluation/test_session.py, for pools in
general in tests/core/test_workers.py; all of it with real commands in test_every_fault.py.
"""

import json
import os

import pytest
from faults import SITE, begun, files_of
from synthetic import RayCaster, write_trajectory

from robocas_ms3.core.errors import IncompleteDatasetError
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.demos.generation import generate
from robocas_ms3.demos.settings import EpisodeSettings, GenerateSettings


@pytest.fixture
def befalls(monkeypatch, tmp_path):
    """(key, fault, times) -> the log of what begins in processes that start from now on."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(SITE), os.environ.get("PYTHONPATH", "")]))

    def tell(key, fault, times, **more):
        told = {"log": str(tmp_path / "log"), "at": {"key": key, "fault": fault, "times": times}, **more}
        monkeypatch.setenv("ROBOCAS_FAULT", json.dumps(told))
        return tmp_path / "log"

    return tell


def test_a_conversion_leaves_out_what_ends_its_process_twice_and_goes_on_later(befalls, tmp_path):
    trajectory = write_trajectory(tmp_path / "trajectory.h5", seeds=(3, 4, 5))
    made = {"embeddings": False, "video": False, "open_renderer": RayCaster, "size": (64, 48)}
    convert(ConversionSettings(trajectory, tmp_path / "whole", **made))
    log = befalls(1, "crash", 2)
    with pytest.raises(IncompleteDatasetError, match=r"out: .*\(found episode_0000001: its.*: SIGSEGV\)") as error:
        convert(ConversionSettings(trajectory, tmp_path / "out", jobs=2, episode_seconds=60, memory_gb=4, **made))
    assert "\n" not in str(error.value)
    assert sorted(key for _, key in begun(log)) == ["0", "1", "1", "2"]
    there = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert there == ["conversion.json", "data_info.json", "episode_0000000", "episode_0000002"]
    assert validate(tmp_path / "out").violations == []
    convert(ConversionSettings(trajectory, tmp_path / "out", **made))
    assert files_of(tmp_path / "out") == files_of(tmp_path / "whole")


def test_a_generation_gives_a_seed_up_that_hangs_twice(befalls, tmp_path):
    log = befalls(1, "hang", 2, made_up=True)
    given_up = []
    settings = GenerateSettings(EpisodeSettings("pick"), tmp_path / "out", episodes=3, episode_seconds=2)
    summary = generate(settings, on_result=lambda result: given_up.extend(result.failures))
    assert [(one.seed, one.stage, one.reason) for one in given_up] == [(1, "worker", "time limit exceeded")]
    assert (summary.episodes, summary.skipped) == (3, [1])
    episodes = json.loads((tmp_path / "out" / "trajectory.json").read_text())["episodes"]
    assert [one["episode_seed"] for one in episodes] == [0, 2, 3]  # another in its place, the others as they were
    assert [key for _, key in begun(log)][:5] == ["0", "1", "1", "2", "3"]
