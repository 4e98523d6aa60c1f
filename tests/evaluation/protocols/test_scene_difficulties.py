"""Difficulties of the scenes of a protocol, measured in its frozen layouts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robocas_ms3.core.errors import EvaluationError, OutputExistsError
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.demos.difficulty import difficulty_file
from robocas_ms3.demos.difficulty.records import RemovalLimits, SceneDifficulty
from robocas_ms3.evaluation.clutter_scale.features import make_features
from robocas_ms3.evaluation.clutter_scale.scale_file import SCALE_FILE, read_scales
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.protocols.scene_difficulties import DIFFICULTIES, measure_protocol, read_difficulties_of

GEOMETRY = ("seed", "target", "objects", "visible_fraction", "obstacles", "free_grasps", "fewest_blockers", "gap")


def test_scenes_are_measured_in_the_frozen_layouts(tmp_path, monkeypatch):
    protocol = load_protocol("clutter-scale-v1")
    expected = read_difficulties_of(protocol)
    numbers = [1, 0, next(n for n, episode in enumerate(protocol.episodes) if episode.task == "search")]
    few = replace(protocol, episodes=tuple(protocol.episodes[number] for number in numbers))
    counts: list[tuple[int, int]] = []
    limits = RemovalLimits(max_removals=0, grasp_attempts=1)
    results = measure_protocol(few, tmp_path, limits, on_start=lambda *start: counts.append(start))
    assert len(list(results)) == 3
    measured = JsonLinesFile(tmp_path / DIFFICULTIES, SceneDifficulty).read()
    for name in GEOMETRY:
        found = [getattr(scene, name) for scene in measured]
        assert found == [pytest.approx(getattr(expected[number], name), abs=1e-3) for number in numbers], name
    assert list(measure_protocol(few, tmp_path, limits, on_start=lambda *start: counts.append(start))) == []
    assert counts == [(3, 0), (3, 3)]
    more = replace(protocol, episodes=(*few.episodes, protocol.episodes[2]))
    next(iter(measure_protocol(more, tmp_path, limits)))
    assert not (tmp_path / DIFFICULTIES).exists(), "not all scenes are measured"
    monkeypatch.setattr(difficulty_file, "hash_source", lambda: "0" * 64)  # of a changed skill
    with pytest.raises(OutputExistsError):
        list(measure_protocol(few, tmp_path, limits))


def test_a_file_of_another_command_is_not_replaced(tmp_path):
    (tmp_path / DIFFICULTIES).write_text("mine")
    with pytest.raises(OutputExistsError):
        next(iter(measure_protocol(load_protocol("clutter-scale-v1"), tmp_path, RemovalLimits(max_removals=0))))
    assert (tmp_path / DIFFICULTIES).read_text() == "mine"


def test_protocol_without_difficulties_is_an_error():
    with pytest.raises(EvaluationError):
        read_difficulties_of(load_protocol("clutter-v1"))


def test_fixed_scale_of_the_bundled_protocol_goes_from_0_to_10():
    protocol = load_protocol("clutter-scale-v1")
    scales = read_scales(protocol.folder / SCALE_FILE)
    assert scales is not None
    features = make_features(read_difficulties_of(protocol))
    for task, stored in scales.items():
        of_task = features[[episode.task == task for episode in protocol.episodes]]
        difficulty = stored.make_scale().compute_difficulty(of_task)
        assert np.nanmin(difficulty) == pytest.approx(0, abs=1e-6)
        assert np.nanmax(difficulty) == pytest.approx(10)
        assert len(stored.fitted) >= 6


def test_difficulties_of_other_scenes_are_an_error(tmp_path):
    protocol = load_protocol("clutter-scale-v1")
    lines = read_difficulties_of(protocol)
    JsonLinesFile(tmp_path / DIFFICULTIES, SceneDifficulty).rewrite([*lines[:-1], replace(lines[-1], seed=7)])
    with pytest.raises(EvaluationError):
        read_difficulties_of(replace(protocol, folder=tmp_path))
