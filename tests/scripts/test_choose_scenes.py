"""Choice of scenes that are evenly spread over the difficulty."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from robocas_ms3.demos.difficulty.records import SceneDifficulty

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "choose_scenes.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("choose_scenes", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # for its dataclass
    spec.loader.exec_module(module)
    return module


def make_scene(seed: int, visible: float) -> tuple[str, SceneDifficulty]:
    return "part", SceneDifficulty(seed, "mug", 5, visible, 0, 1, 0, 0.1, 0, [], None, 0, True)


def test_groups_get_equal_numbers_and_small_groups_all_their_scenes(script):
    groups = {
        ("pick", 0): [make_scene(seed, seed / 100) for seed in range(50)],
        ("pick", 1): [make_scene(seed, seed / 100) for seed in range(50, 53)],
        ("search", 0): [make_scene(seed, seed / 100) for seed in range(60, 100)],
    }
    chosen = [scene.seed for _, scene in script.choose_evenly(groups, 23)]
    assert len(chosen) == len(set(chosen)) == 23
    assert [sum(first <= seed < end for seed in chosen) for first, end in ((0, 50), (50, 53), (60, 100))] == [10, 3, 10]


def test_scenes_of_a_group_are_spread_over_the_visible_fraction(script):
    scenes = [make_scene(seed, (7 * seed % 41) / 40) for seed in range(41)]
    visible = sorted(scene.visible_fraction for _, scene in script.choose_evenly({("pick", 0): scenes}, 5))
    assert visible == [0, 0.25, 0.5, 0.75, 1]


def test_more_scenes_than_there_are_means_all(script):
    scenes = [make_scene(seed, 0.5) for seed in range(3)]
    assert len(script.choose_evenly({("pick", 0): scenes}, 10)) == 3


def test_scenes_of_the_source_are_measured_and_chosen(script, tmp_path, monkeypatch):
    """The measured seeds and the pack are those of the source, and scenes with too few removals are left out."""
    source = {
        "rules": {"name": "mine", "pack": "builtin", "max_seconds": {"search": 60}},
        "parts": [
            {"config": "search_table_small_heap", "name": "first", "seeds": [7, 9]},
            {"config": "search_table_small_heap", "name": "second", "count": 3, "first_seed": 20},
        ],
    }
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(source))
    measured = {}

    def measure_seeds(settings, seeds, out, **others):
        measured[out.name] = (settings.pack, list(seeds))
        return []

    def read_difficulties(folder):
        return [replace(make_scene(seed, 0.5)[1], removals=seed % 2) for seed in measured[folder.name][1]]

    monkeypatch.setattr(script, "measure_seeds", measure_seeds)
    monkeypatch.setattr(script, "read_difficulties", read_difficulties)
    out = tmp_path / "out"
    out.mkdir()
    script.main(script.Options(tmp_path / "mine.yaml", out, scenes=10, min_removals=1, jobs=1))
    assert measured == {"first": ("builtin", [7, 9]), "second": ("builtin", [20, 21, 22])}
    written = yaml.safe_load((out / "source.yaml").read_text())
    assert [part["seeds"] for part in written["parts"]] == [[7, 9], [21]]
    lines = (out / "difficulty.jsonl").read_text().splitlines()
    assert [json.loads(line)["seed"] for line in lines] == [7, 9, 21]
