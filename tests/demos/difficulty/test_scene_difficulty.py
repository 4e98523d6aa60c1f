"""Difficulty of simulated scenes, and its stored results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robocas_ms3.core.errors import ConfigError, OutputExistsError
from robocas_ms3.demos.difficulty import difficulty_file
from robocas_ms3.demos.difficulty.difficulty_file import DifficultySettings, measure_seeds, read_difficulties
from robocas_ms3.demos.difficulty.records import RemovalLimits
from robocas_ms3.demos.difficulty.scene_difficulty import measure_gap
from robocas_ms3.scenes.config import load_task_config

GROUP = {"layout.min_gap": 0.002, "objects.count": 5, "surface.min_xy": [0, -0.1], "surface.max_xy": [0.2, 0.1]}
BLOCKED, FREE = 985016, 985013  # a tube between bottles, a free bottle
HEAPS = range(985200, 985216)


def make_settings(**keys: object) -> DifficultySettings:
    options = [f"{key}={value}" for key, value in {**GROUP, "target.min_free_grasps": 0, **keys}.items()]
    content = load_task_config("pick_table_scattered", set_options=options).model_dump(mode="json")
    return DifficultySettings("pick", content, limits=RemovalLimits(max_removals=1))


def test_gap_is_the_mean_of_the_three_nearest_objects():
    target = np.zeros((1, 3))
    near, far = np.array([[0.03, 0, 0], [0.5, 0, 0]]), np.array([[0, 0.9, 0]])
    assert measure_gap(target, [near, far]) == pytest.approx((0.03 + 0.2 + 0.2) / 3)
    assert measure_gap(target, []) == pytest.approx(0.2)


def test_scenes_are_measured_stored_and_not_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    settings = make_settings()
    results = list(measure_seeds(settings, [FREE, BLOCKED], tmp_path / "out", jobs=2))
    assert sorted(result.seed for result in results) == [FREE, BLOCKED]
    free, blocked = read_difficulties(tmp_path / "out")
    assert (free.target, free.removals, free.first_removals, free.obstacles) == ("shower_cream", 0, [], 0)
    assert free.free_grasps > 0
    assert free.fewest_blockers == 0
    assert free.visible_fraction == 1
    assert (blocked.target, blocked.free_grasps, blocked.fewest_blockers) == ("toothpaste", 0, 1)
    assert blocked.removals == 1, "one object blocks all grasps"
    assert len(blocked.first_removals) >= 1
    assert blocked.complete
    assert 0 < blocked.gap < 0.05

    measured: list[int] = []
    assert list(measure_seeds(settings, [FREE, BLOCKED], tmp_path / "out", on_start=measured.append)) == []
    assert measured == [2]
    with pytest.raises(OutputExistsError):
        list(measure_seeds(make_settings(**{"objects.count": 4}), [FREE], tmp_path / "out"))
    monkeypatch.setattr(difficulty_file, "hash_source", lambda: "0" * 64)  # of a changed skill
    with pytest.raises(OutputExistsError):
        list(measure_seeds(settings, [FREE], tmp_path / "out"))


def test_first_removal_of_the_scripted_policy_is_measured_in_search(tmp_path: Path):
    content = load_task_config("search_table_small_heap", set_options=["objects.count=5"]).model_dump(mode="json")
    settings = DifficultySettings("search", content, limits=RemovalLimits(max_removals=1))
    results = measure_seeds(settings, HEAPS, tmp_path / "out", jobs=2)  # heaps depend on the processor
    measured = (result.difficulty for result in results)
    scene = next(scene for scene in measured if scene is not None and scene.scripted_removal is not None)
    assert scene.removals == 1
    assert scene.scripted_removal in range(scene.objects)
    assert set(scene.first_removals) < set(range(scene.objects)), "the target itself is not removed"


def test_scenes_that_are_reached_from_the_front_have_no_difficulty(tmp_path: Path):
    settings = DifficultySettings("pick", "pick_shelf_scattered")
    with pytest.raises(ConfigError):
        list(measure_seeds(settings, [0], tmp_path / "out"))
    assert not (tmp_path / "out").exists()
