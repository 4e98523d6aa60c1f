from typing import Any

import numpy as np
import pytest

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import AssetError, RobocasError
from robocas_ms3.scenes.config import bundled_configs, load_task_config
from robocas_ms3.scenes.language.instructions import (
    SPLITS,
    Instruction,
    InstructionSlots,
    draw_instruction,
    fits_name,
    is_plural,
    make_instruction,
    part_name,
    template_ids,
)
from robocas_ms3.scenes.language.texts import Split, load_instruction_texts, load_synonym_texts
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.task_specs import TASKS

EXTRA = {"pick": {}, "search": {}, "select": {"relation": "nearest"}, "open_pick": {"part": "left door"}}


def slots(task: str = "pick", object: str = "apple", support: str = "table", **more: Any) -> InstructionSlots:
    return InstructionSlots(task, object, support, **{**EXTRA[task], **more})


def choose(seed: int, about: InstructionSlots | None = None, split: Split = "train", **options: Any) -> Instruction:
    return draw_instruction(np.random.default_rng(seed), about or slots(), split, **options)


@pytest.mark.parametrize(
    ("task", "text"),
    [
        ("pick", "grasp the scissors on the table and move it to the basket"),
        ("select", "grasp the nearest scissors on the table and move it to the basket"),
        ("search", "search the scissors from the objects on the table and transfer it to the basket"),
        ("open_pick", "open the left door of the table, grasp the scissors and move them to the basket"),
    ],
)
def test_defaults_are_the_texts_of_robocas_v0(task, text):
    about = slots(task, "scissors")
    found = make_instruction(about)
    assert found.text == text
    assert (found.template_id, found.split, found.object_word) == (f"{task}/upstream/00", "upstream", "scissors")
    assert choose(5, about, "upstream") == found


@pytest.mark.parametrize(
    ("relation", "phrase"),
    [
        ("nearest", "nearest mug"),
        ("second_nearest", "second nearest mug"),
        ("farthest", "farthest mug"),
        ("leftmost", "leftmost mug"),
        ("second_from_left", "second mug from the left"),
        ("middle", "middle mug"),
        ("second_from_right", "second mug from the right"),
        ("rightmost", "rightmost mug"),
        (None, "mug"),  # as in RoboCAS-v0, without a relation
    ],
)
def test_relations(relation, phrase):
    found = make_instruction(slots("select", "mug", "shelf", relation=relation))
    assert found.text == f"grasp the {phrase} on the shelf and move it to the basket"
    assert found.relation_phrase == (phrase.replace("mug", "{object}") if relation else "")


def test_number_and_preposition():
    def pick(object, support):
        return make_instruction(slots("pick", object, support), "pick/train/05").text

    assert pick("scissors", "cabinet") == "grab the scissors in the cabinet and put them in the basket"
    assert pick("pair of scissors", "shelf") == "grab the pair of scissors on the shelf and put it in the basket"
    assert is_plural("red scissors")
    assert not is_plural("scissors box")
    texts = {choose(seed, slots(support="cabinet")).text for seed in range(300)}
    assert any("in the cupboard" in text for text in texts)  # a synonym keeps the preposition
    assert not any("on the c" in text for text in texts)


@pytest.mark.parametrize("name", sorted(bundled_configs()))
def test_preposition_is_in_for_supports_with_headroom(name):
    config = load_task_config(name)
    try:
        model = SceneModel.load(config, load_pack("builtin"), load_pack("builtin"))
    except AssetError:  # needs a pack that the user imports
        return
    inside = np.isfinite(model.headroom) and "shelf" not in config.support
    wanted, other = ("in", "on") if inside else ("on", "in")
    texts = {choose(seed, slots(support=config.support), synonyms=False).text for seed in range(60)}
    assert any(f" {wanted} the {config.support}" in text for text in texts)
    assert not any(f" {other} the {config.support}" in text for text in texts)


def test_draws_are_repeatable_and_reach_everything():
    found = [choose(seed) for seed in range(400)]
    assert found == [choose(seed) for seed in range(400)]
    assert {item.template_id for item in found} == set(template_ids("pick", "train"))
    assert {item.object_word for item in found} == {"apple", *load_synonym_texts().objects["apple"].train}
    assert {item.support_word for item in found} == {"table", *load_synonym_texts().supports["table"].train}
    phrases = {choose(seed, slots("select"), "held_out").relation_phrase for seed in range(100)}
    nearest = load_instruction_texts().relations["nearest"]
    assert phrases == {nearest.plain, *nearest.held_out}


def test_every_draw_moves_the_generator_by_the_same_amount():
    states = set()
    for task in TASKS:
        for split in SPLITS:
            for synonyms in (True, False):
                rng = np.random.default_rng(1)
                draw_instruction(rng, slots(task), split, synonyms=synonyms)
                states.add(rng.random())
    assert len(states) == 1


def test_held_out_and_train_have_only_plain_words_in_common():
    for task in TASKS:
        train, held_out = ([choose(s, slots(task), split) for s in range(200)] for split in ("train", "held_out"))
        for attribute in ("text", "template_id"):
            assert not {getattr(i, attribute) for i in train} & {getattr(i, attribute) for i in held_out}
        assert {i.object_word for i in train} & {i.object_word for i in held_out} == {"apple"}


def test_synonyms_can_be_left_out():
    found = [choose(seed, slots("select"), "held_out", synonyms=False) for seed in range(100)]
    assert {(i.object_word, i.support_word, i.relation_phrase) for i in found} == {
        ("apple", "table", "nearest {object}")
    }
    assert len({i.template_id for i in found}) == 7


def test_synonyms_that_fit_another_object_are_not_used():
    def words(*others):
        return {choose(seed, slots(object="mug"), others=others).object_word for seed in range(100)}

    assert words("mug", "apple") == {"mug", "cup", "coffee mug"}
    assert words("paper cup") == {"mug", "coffee mug"}
    assert fits_name("shampoo bottle", "white shampoo bottle")
    assert not fits_name("white shampoo bottle", "shampoo bottle")


@pytest.mark.parametrize(
    ("link", "name"),
    [
        ("door", "door"),
        ("door_left", "left door"),
        ("freezer_door", "freezer door"),
        ("glass_door_left", "left glass door"),
        ("left", "left"),
    ],
)
def test_part_names(link, name):
    assert part_name(link) == name


@pytest.mark.parametrize(
    ("task", "more"), [("pick", {"relation": "nearest"}), ("open_pick", {"part": ""}), ("search", {"part": "door"})]
)
def test_relation_and_part_belong_to_their_tasks(task, more):
    with pytest.raises(RobocasError) as caught:
        slots(task, **more)
    assert caught.value.where == task


@pytest.mark.parametrize("template_id", ["pick/train/21", "pick/train/-1", "search/train/00", "pick/train", "7"])
def test_unknown_templates(template_id):
    with pytest.raises(RobocasError) as caught:
        make_instruction(slots(), template_id)
    assert caught.value.where == template_id


def test_unknown_objects_and_supports_have_their_plain_names():
    about = slots(object="gizmo {0}", support="lectern")
    assert {choose(seed, about).object_word for seed in range(20)} == {"gizmo {0}"}
    assert "on the lectern" in make_instruction(about, "pick/train/05").text
