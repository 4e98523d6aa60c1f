"""Suites that hold something out: what is tested is not in the configurations to train on."""

from itertools import combinations

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
    protocol, objects, found = suite("objects"), load_pack("builtin").objects, {}
    layouts = {one.config: FrozenLayouts(protocol.layouts_file(one.config), objects) for one in protocol.episodes}
    for episode in protocol.episodes:
        layout = layouts[episode.config](episode.seed, episode.seed)
        standing = {identifier for identifier, used in zip(layout.object_ids, layout.present, strict=True) if used}
        found.setdefault(episode.split, set()).update(standing)
    assert set(found) == {"seen", "new", "new_kind"}
    for one, other in combinations(found.values(), 2):
        assert not one & other
    ids = {split: set(config.objects.ids) for split, config in held_out_of("objects")}
    ids["seen"] = set(trained("objects")["pick"].objects.ids)
    assert {frozenset(config.objects.ids) for config in trained("objects").values()} == {frozenset(ids["seen"])}
    for one, other in combinations(ids.values(), 2):
        assert not one & other
    assert all(found[split] <= ids[split] for split in found)
    kinds = {split: {objects[one].asset.category for one in ids} for split, ids in found.items()}
    assert kinds["new"] <= kinds["seen"]
    assert not kinds["new_kind"] & (kinds["seen"] | kinds["new"])


def test_instructions():
    splits = {}
    for episode in suite("instructions").episodes:
        splits.setdefault(episode.split, []).append(episode)
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
