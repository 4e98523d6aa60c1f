"""Suites that hold something out: what is tested is not in what may be trained on, as their own files tell."""

from itertools import combinations

import numpy as np
import pytest

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.evaluation.protocol import load_protocol
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.language.texts import instruction_texts, synonym_texts
from robocas_ms3.scenes.table import FrozenLayouts

SUITES = ("objects", "arrangement", "clutter", "instructions", "cameras", "looks", "furniture", "paper-words")


def suite(name):
    return load_protocol(f"{name}-v1")


def trained(name):
    """Configurations to train on, by task."""
    return {config.task: config for config in map(load_task_config, suite(name).train_files())}


def held_out_of(name):
    """(split, configuration) of what is held out."""
    protocol = suite(name)
    pairs = {(episode.split, episode.config) for episode in protocol.episodes if episode.split != "seen"}
    return [(split, load_task_config(protocol.config_file(config))) for split, config in sorted(pairs)]


def standing(name):
    """Split -> ids of all that stands in its frozen scenes."""
    protocol, found = suite(name), {}
    for episode in protocol.episodes:
        layouts = FrozenLayouts(protocol.layouts_file(episode.config), load_pack("builtin").objects)
        layout = layouts(episode.seed, episode.seed)
        here = [identifier for identifier, used in zip(layout.object_ids, layout.present, strict=True) if used]
        found.setdefault(episode.split, []).append((episode, here))
    return found


@pytest.mark.parametrize("name", SUITES)
def test_what_is_seen_is_what_is_trained_on(name):
    protocol = suite(name)
    seen = {episode.config for episode in protocol.episodes if episode.split == "seen"}
    configs = [load_task_config(protocol.config_file(config)) for config in sorted(seen)]
    train = trained(name)
    assert {config.task: config for config in configs} == train
    assert len(configs) == len(protocol.train_files())
    assert {config.task for _, config in held_out_of(name)} == set(train)


def test_objects():
    found = {split: {one for _, here in scenes for one in here} for split, scenes in standing("objects").items()}
    assert set(found) == {"seen", "new", "new_kind"}
    for one, other in combinations(found.values(), 2):
        assert not one & other
    ids = {split: set(config.objects.ids) for split, config in held_out_of("objects")}
    ids["seen"] = set(trained("objects")["pick"].objects.ids)
    assert {frozenset(config.objects.ids) for config in trained("objects").values()} == {frozenset(ids["seen"])}
    for one, other in combinations(ids.values(), 2):
        assert not one & other
    assert all(found[split] <= ids[split] for split in found)
    objects = load_pack("builtin").objects
    kinds = {split: {objects[one].asset.category for one in ids} for split, ids in found.items()}
    assert kinds["new"] <= kinds["seen"]
    assert not kinds["new_kind"] & (kinds["seen"] | kinds["new"])


def test_arrangement():
    kinds = {split: config.layout.kind for split, config in held_out_of("arrangement")}
    assert kinds == {"orderly": "orderly", "stacked": "stacked"}
    assert trained("arrangement")["pick"].layout.kind == "scattered"


def test_clutter():
    for split, config in held_out_of("clutter"):
        before = trained("clutter")[config.task]
        assert (split, config.layout.kind) == ("more", before.layout.kind)
        assert config.objects.count > before.objects.count
        assert config.surface == before.surface
    for split, scenes in standing("clutter").items():
        assert {len(here) for _, here in scenes} == ({6} if split == "seen" else {12, 13})


def test_instructions():
    splits = {split: [one for one, _ in scenes] for split, scenes in standing("instructions").items()}
    seen = splits["seen"]
    for split, episodes in splits.items():
        same = [(one.task, one.seed, one.target) for one in episodes]
        assert same == [(one.task, one.seed, one.target) for one in seen], split
    names = {one: asset.asset.name for one, asset in load_pack("builtin").objects.items()}
    held_out = {text for one in seen for text in instruction_texts().tasks[one.task].of("held_out")}
    assert held_out.isdisjoint({text for one in seen for text in instruction_texts().tasks[one.task].of("train")})
    for meant, words, wrong, nothing in zip(seen, splits["paraphrase"], splits["wrong"], splits["empty"], strict=True):
        assert nothing.instruction == ""
        assert len({meant.instruction, words.instruction, wrong.instruction}) == 3
        name = names[meant.target]
        synonyms = synonym_texts().objects.get(name)
        called = {name, *(() if synonyms is None else (*synonyms.of("train"), *synonyms.of("held_out")))}
        assert not any(word in wrong.instruction for word in called)
    assert {config.language.split for split, config in held_out_of("instructions") if split == "paraphrase"} == {
        "held_out"
    }
    assert {config.language.split for config in trained("instructions").values()} == {"train"}


@pytest.mark.parametrize(
    ("name", "tasks", "splits"),
    [
        (
            "instructions",
            ("pick_table_scattered", "select_table_orderly", "search_table_small_heap"),
            ("paraphrase", "wrong", "empty"),
        ),
        ("paper-words", ("pick_upstream_eval",), ("wrong", "empty")),
    ],
)
def test_the_scenes_of_all_instructions_are_the_same(name, tasks, splits):
    folder = suite(name).folder / "layouts"
    for task in tasks:
        seen = np.load(folder / f"{task}-seen.npy")
        for split in splits:
            assert np.load(folder / f"{task}-{split}.npy").tobytes() == seen.tobytes()


def test_the_words_of_the_paper_are_its_own_anothers_and_none():
    splits = {split: [one for one, _ in scenes] for split, scenes in standing("paper-words").items()}
    names = {one: asset.asset.name for one, asset in load_pack("builtin").objects.items()}
    assert set(splits) == {"seen", "wrong", "empty"}
    for meant, wrong, nothing in zip(splits["seen"], splits["wrong"], splits["empty"], strict=True):
        assert names[meant.target] in meant.instruction
        assert names[meant.target] not in wrong.instruction
        assert any(name in wrong.instruction for name in names.values())
        assert nothing.instruction == ""
        assert meant.target == wrong.target == nothing.target


def test_cameras():
    for _, config in held_out_of("cameras"):
        before, now = trained("cameras")[config.task].randomisation.cameras, config.randomisation.cameras
        assert before is not None
        assert now is not None
        assert now.min_position > before.position
        assert now.min_rotation_deg > before.rotation_deg
    least = {split: config.randomisation.cameras for split, config in held_out_of("cameras")}
    assert least["far"].min_position > least["near"].position


def test_looks():
    for split, config in held_out_of("looks"):
        before = trained("looks")[config.task]
        for part, finishes in config.randomisation.finishes.items():
            both = set(finishes) & set(before.randomisation.finishes[part])
            assert bool(both) == (split == "light"), part
        lights, others = config.randomisation.lights, before.randomisation.lights
        if split == "texture":
            assert (config.lights, lights) == (before.lights, others)
            continue
        assert lights.ambient[1] < others.ambient[0]
        assert lights.directional[0] > others.directional[1]
        one, other = (np.array(c.lights.direction) / np.linalg.norm(c.lights.direction) for c in (config, before))
        assert np.rad2deg(np.arccos(one @ other)) > lights.direction_deg + others.direction_deg


def test_furniture():
    seen = {piece.asset for config in trained("furniture").values() for piece in config.furniture.values()}
    for _, config in held_out_of("furniture"):
        assert config.furniture[config.surface.furniture].asset not in seen
