"""Statistics of candidates.h5: rates and choices worked out by hand, files and table of the command."""

import json

import numpy as np
import pytest
from PIL import Image
from synthetic import write_trajectory
from synthetic_candidates import ENV_INFO, SETTINGS, make_record, write_episodes

from robocas_ms3.cli.main import run
from robocas_ms3.datasets.statistics.candidates import ALL_SOURCES, Rate, compute_candidate_statistics
from robocas_ms3.demos.candidates.candidates_file import write_candidates

CLUTTERED = {"obstacles": [3, 0], "hidden_fraction": [0.0, 0.0], "free_grasps": [9, 9]}  # 20 s for slot 0
CLEARED = {"obstacles": [1, 0], "hidden_fraction": [0.0, 0.0], "free_grasps": [9, 9]}  # 0 s
DONE = {"feasible": True, "success": True, "failure": "", "held": False, "seconds": 4.0}


def make_push(record, **values):
    base = next(candidate for candidate in record.candidates if candidate["primitive"] == "push")
    return {**base, "slot": 1, "chosen": False, "source": "random", **DONE, **CLEARED, **values}


@pytest.fixture
def path(tmp_path):
    """Two decisions: four pushes, of which one is infeasible and one drops an object, and two pushes."""
    first, second = make_record(3, 0, slots=2), make_record(3, 1, slots=2)
    for record in (first, second):
        record.values |= CLUTTERED
    failed = {"success": False, "failure": "push: no_free_push", "seconds": 0.0, **CLUTTERED}
    first.candidates = [
        make_push(first, source="expert", chosen=True, seconds=6.0),
        make_push(first, seconds=4.0),
        make_push(first, feasible=False, **failed),
        make_push(first, fallen=[False, True], success=False, failure="clear: fell_off_table"),
    ]
    second.candidates = [make_push(second, source="expert", chosen=True), make_push(second, **CLUTTERED)]
    write_candidates(tmp_path / "c.h5", [first, second], ENV_INFO, SETTINGS)
    return tmp_path / "c.h5"


def test_rates_and_choices(path):
    stats = compute_candidate_statistics([path])
    assert (stats.tasks, stats.episodes, stats.decisions, stats.candidates) == (("search",), 1, 2, 6)
    assert stats.kinds == {"move": 2}
    assert stats.primitives.keys() == {"push"}
    pushes = stats.primitives["push"]
    assert {source: of.candidates for source, of in pushes.items()} == {ALL_SOURCES: 6, "expert": 2, "random": 4}
    of = pushes[ALL_SOURCES]
    assert (of.feasible, of.success, of.helped, of.fell) == (Rate(5, 6), Rate(4, 6), Rate(3, 5), Rate(1, 5))
    assert of.mean_seconds == pytest.approx((6 + 4 + 4 + 4 + 4) / 5)
    # values: 20 - 6 (chosen) and 20 - 4; 20 - 4 (chosen) and 0 - 4
    assert stats.choices["move"].best == Rate(1, 2)
    assert stats.choices["move"].mean_regret == pytest.approx(1.0)
    assert stats.failures == {"push: no_free_push": 1, "clear: fell_off_table": 1}
    assert sorted(stats.benefits["push"].tolist()) == [0, 20, 20, 20, 20]


def test_interval_of_a_rate():
    low, high = Rate(0, 10).limits
    assert (low, high) == (0, pytest.approx(1 - 0.025**0.1))  # Clopper and Pearson
    assert Rate(0, 0).as_json() is None
    assert np.isnan(Rate(0, 0).limits).all()


def test_command_writes_json_and_plots_and_prints_a_table(path, capsys):
    assert run(["stats", str(path)]) == 0
    out = capsys.readouterr().out
    assert "push" in out
    assert "67% [22%, 96%]" in out
    folder = path.parent / "c_stats"
    assert {file.name for file in folder.iterdir()} == {"stats.json", "outcomes.png", "benefits.png", "failures.png"}
    content = json.loads((folder / "stats.json").read_text())
    assert content["primitives"]["push"]["all"]["success"]["k"] == 4
    for image in folder.glob("*.png"):
        assert Image.open(image).width > 200
    assert run(["stats", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == content


def test_empty_file(tmp_path):
    write_candidates(tmp_path / "c.h5", [], ENV_INFO, SETTINGS)
    stats = compute_candidate_statistics([tmp_path / "c.h5"])
    assert stats.summary() == "search: 0 episodes, 0 decisions, 0 candidates"
    assert run(["stats", str(tmp_path / "c.h5")]) == 0


def test_all_primitives_of_an_episode(tmp_path):
    stats = compute_candidate_statistics([write_episodes(tmp_path / "c.h5", seeds=range(5))])
    assert list(stats.primitives) == ["grasp", "push", "lift"]
    assert stats.candidates == 5 * 2 * 6


def test_several_files_count_as_one(path, tmp_path, capsys):
    other = write_episodes(tmp_path / "other.h5", seeds=range(5))
    alone, both = compute_candidate_statistics([path]), compute_candidate_statistics([path, other])
    assert (both.tasks, both.episodes, both.candidates) == (("search",), 6, 6 + 5 * 2 * 6)
    pushes = compute_candidate_statistics([other]).primitives["push"][ALL_SOURCES].success
    assert both.primitives["push"][ALL_SOURCES].success == Rate(4 + pushes.k, 6 + pushes.n)
    assert len(both.benefits["push"]) > len(alone.benefits["push"])
    assert run(["stats", str(path), str(other)]) == 0
    assert "2 files: search: 6 episodes" in capsys.readouterr().out
    assert not list(tmp_path.glob("*_stats"))
    assert run(["stats", str(path), str(other), "--out", str(tmp_path / "plots")]) == 0
    assert (tmp_path / "plots" / "stats.json").exists()


def test_recordings_are_not_counted_together(path, tmp_path):
    trajectory = write_trajectory(tmp_path / "trajectory.h5", seeds=(3,))
    assert run(["stats", str(trajectory)]) == 0
    assert run(["stats", str(trajectory), str(path)]) == 2
