"""Faults in worker processes of conversion and generation, with synthetic episodes: the fast tests of the suite.

tests/plans/test_run_plan.py has such tests for plans, tests/evaluation/rollouts/test_session.py for evaluation, and
tests/core/test_workers.py for worker pools. test_every_fault.py has those with real commands.
"""

import json
import os

import pytest
from faults import SITE, files_of, task_starts
from synthetic import RayCaster, write_trajectory

from robocas_ms3.core.errors import IncompleteDatasetError
from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.demos.generation import generate
from robocas_ms3.demos.settings import EpisodeSettings, GenerateSettings


@pytest.fixture
def inject(monkeypatch, tmp_path):
    """Return a function (key, fault, times) that injects a fault into later processes, and returns their log."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(SITE), os.environ.get("PYTHONPATH", "")]))

    def set_fault(key, fault, times, **more):
        injection = {"log": str(tmp_path / "log"), "at": {"key": key, "fault": fault, "times": times}, **more}
        monkeypatch.setenv("ROBOCAS_FAULT", json.dumps(injection))
        return tmp_path / "log"

    return set_fault


def test_conversion_skips_an_episode_that_crashes_twice_and_adds_it_later(inject, tmp_path):
    trajectory = write_trajectory(tmp_path / "trajectory.h5", seeds=(3, 4, 5))
    options = {"embeddings": False, "video": False, "open_renderer": RayCaster, "size": (64, 48)}
    convert(ConversionSettings(trajectory, tmp_path / "whole", **options))
    log = inject(1, "crash", 2)
    with pytest.raises(IncompleteDatasetError, match=r"out: .*\(found episode_0000001: its.*: SIGSEGV\)") as error:
        convert(ConversionSettings(trajectory, tmp_path / "out", jobs=2, episode_seconds=60, memory_gb=4, **options))
    assert "\n" not in str(error.value)
    assert sorted(key for _, key in task_starts(log)) == ["0", "1", "1", "2"]
    files = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert files == ["conversion.json", "data_info.json", "episode_0000000", "episode_0000002"]
    assert validate(tmp_path / "out").violations == []
    convert(ConversionSettings(trajectory, tmp_path / "out", **options))
    assert files_of(tmp_path / "out") == files_of(tmp_path / "whole")


def test_generation_skips_a_seed_that_hangs_twice(inject, tmp_path):
    log = inject(1, "hang", 2, stub_episodes=True)
    failures = []
    settings = GenerateSettings(EpisodeSettings("pick"), tmp_path / "out", episodes=3, episode_seconds=2)
    summary = generate(settings, on_result=lambda result: failures.extend(result.failures))
    assert [(one.seed, one.stage, one.reason) for one in failures] == [(1, "worker", "time limit exceeded")]
    assert (summary.episodes, summary.skipped) == (3, [1])
    episodes = json.loads((tmp_path / "out" / "trajectory.json").read_text())["episodes"]
    assert [one["episode_seed"] for one in episodes] == [0, 2, 3]  # another seed replaces the skipped one
    assert [key for _, key in task_starts(log)][:5] == ["0", "1", "1", "2", "3"]
