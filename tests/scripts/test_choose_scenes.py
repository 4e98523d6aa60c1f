"""Choice of scenes that are evenly spread over the difficulty."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import EvaluationError, OutputExistsError
from robocas_ms3.demos.difficulty.records import SceneDifficulty
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.protocols.scene_difficulties import read_difficulties_of
from robocas_ms3.scenes.layout_table import FrozenLayouts

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "choose_scenes.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("choose_scenes", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # for its dataclass
    spec.loader.exec_module(module)
    return module


def make_scene(seed: int, visible: float) -> SimpleNamespace:
    return SimpleNamespace(
        difficulty=SceneDifficulty(seed, "mug", 5, visible, 0, 1, 0, 0.1, 0, [], None, 0, complete=True)
    )


def test_groups_get_equal_numbers_and_small_groups_all_their_scenes(script):
    groups = {
        ("pick", 0): [make_scene(seed, seed / 100) for seed in range(50)],
        ("pick", 1): [make_scene(seed, seed / 100) for seed in range(50, 53)],
        ("search", 0): [make_scene(seed, seed / 100) for seed in range(60, 100)],
    }
    chosen = [scene.difficulty.seed for scene in script.choose_evenly(groups, 23)]
    assert len(chosen) == len(set(chosen)) == 23
    assert [sum(first <= seed < end for seed in chosen) for first, end in ((0, 50), (50, 53), (60, 100))] == [10, 3, 10]


def test_scenes_of_a_group_are_spread_over_the_visible_fraction(script):
    scenes = [make_scene(seed, (7 * seed % 41) / 40) for seed in range(41)]
    chosen = script.choose_evenly({("pick", 0): scenes}, 5)
    visible = sorted(scene.difficulty.visible_fraction for scene in chosen)
    assert visible == [0, 0.25, 0.5, 0.75, 1]


def test_more_scenes_than_there_are_means_all(script):
    scenes = [make_scene(seed, 0.5) for seed in range(3)]
    assert len(script.choose_evenly({("pick", 0): scenes}, 10)) == 3


def test_chosen_episodes_are_a_protocol_with_their_layouts_and_difficulties(script, tmp_path):
    source = load_protocol("clutter-scale-v1")
    difficulties = read_difficulties_of(source)
    out = tmp_path / "mine"
    script.main(script.Options(("clutter-scale-v1",), out, "mine", "Hard scenes.", scenes=25, min_removals=1))
    chosen = load_protocol(out)
    assert (chosen.rules.name, chosen.rules.description) == ("mine", "Hard scenes.")
    assert [episode.episode for episode in chosen.episodes] == list(range(25))
    number = {(episode.config, episode.seed): episode.episode for episode in source.episodes}
    numbers = [number[episode.config, episode.seed] for episode in chosen.episodes]
    assert numbers == sorted(numbers)
    assert read_difficulties_of(chosen) == [difficulties[number] for number in numbers]
    assert all(difficulties[number].removals for number in numbers)
    names = load_pack("builtin").objects
    for episode in chosen.episodes:
        ours, theirs = (
            FrozenLayouts(protocol.layouts_file(episode.config), names)(episode.seed, episode.seed)
            for protocol in (chosen, source)
        )
        assert ours.object_ids == theirs.object_ids
        assert np.array_equal(ours.object_poses, theirs.object_poses)
    with pytest.raises(OutputExistsError):
        script.main(script.Options(("clutter-scale-v1",), out, "mine"))


def choose(script: ModuleType, out: Path, *protocols: Path | str, scenes: int = 300, min_removals: int = 0) -> Path:
    script.main(script.Options(tuple(map(str, protocols)), out, "mine", scenes=scenes, min_removals=min_removals))
    return out


def test_scenes_without_known_removals_are_left_out(script, tmp_path):
    whole = choose(script, tmp_path / "whole", "clutter-scale-v1", min_removals=2)
    found = read_difficulties_of(load_protocol(whole))
    assert {scene.removals for scene in found} == {2, 3}
    assert all(scene.complete for scene in found)
    with pytest.raises(EvaluationError):
        choose(script, tmp_path / "none", "clutter-scale-v1", min_removals=4)
    assert not (tmp_path / "none").exists()


def split_protocol(folder: Path, out: Path, numbers: range) -> Path:
    """Write a protocol folder with some of the episodes of another one; its other files do not change."""
    shutil.copytree(folder, out)
    for name in ("episodes.jsonl", "difficulty.jsonl"):
        lines = (folder / name).read_text().splitlines()
        (out / name).write_text("".join(f"{lines[number]}\n" for number in numbers))
    episodes = [json.loads(line) | {"episode": i} for i, line in enumerate((out / "episodes.jsonl").open())]
    (out / "episodes.jsonl").write_text("".join(json.dumps(episode) + "\n" for episode in episodes))
    return out


def test_protocols_that_were_measured_in_pieces_become_one(script, tmp_path):
    whole = choose(script, tmp_path / "whole", "clutter-scale-v1", scenes=12)
    pieces = [split_protocol(whole, tmp_path / f"{i}", range(6 * i, 6 * i + 6)) for i in range(2)]
    joined = choose(script, tmp_path / "joined", *pieces)
    assert load_protocol(joined).hash == load_protocol(whole).hash
    assert (joined / "difficulty.jsonl").read_text() == (whole / "difficulty.jsonl").read_text()
    with pytest.raises(EvaluationError):
        choose(script, tmp_path / "twice", pieces[0], whole)


@pytest.mark.parametrize("file", ["protocol.yaml", "configs/search_small.yaml"])
def test_protocols_with_different_rules_or_configurations_are_refused(script, tmp_path, file):
    whole = choose(script, tmp_path / "whole", "clutter-scale-v1")
    first, second = (split_protocol(whole, tmp_path / f"{i}", range(i, 300, 2)) for i in range(2))
    path = second / file
    path.write_text(path.read_text().replace("max_seconds:", "max_steps: 70\nmax_seconds:") + "\n")
    with pytest.raises(EvaluationError):
        choose(script, tmp_path / "joined", first, second)
    assert not (tmp_path / "joined").exists()
