import json
import re
from itertools import combinations

import pytest
import yaml

from robocas_ms3.core.errors import ConfigError
from robocas_ms3.core.paths import builtin_packs_dir
from robocas_ms3.scenes.language.instructions import (
    SPLITS,
    InstructionSlots,
    fits_name,
    make_instruction,
    template_ids,
)
from robocas_ms3.scenes.language.texts import (
    INSTRUCTIONS_FILE,
    InstructionTexts,
    load_instruction_texts,
    load_synonym_texts,
    read_texts,
)
from robocas_ms3.scenes.relations import RELATIONS
from robocas_ms3.scenes.task_specs import TASKS

TEXTS, WORDS = load_instruction_texts(), load_synonym_texts()
NAMES = sorted(
    asset["name"]
    for asset in json.loads((builtin_packs_dir() / "builtin" / "manifest.json").read_text())["assets"]
    if asset["kind"] == "object"
)


def test_every_task_has_its_paraphrases():
    assert set(TEXTS.tasks) == set(TASKS)
    for templates in TEXTS.tasks.values():
        assert len(templates.upstream) == 1
        assert len(templates.train) + len(templates.held_out) >= 20
        assert 0.7 < len(templates.train) / (len(templates.train) + len(templates.held_out)) < 0.8


def test_templates_are_unique_over_both_splits():
    for templates in TEXTS.tasks.values():
        texts = [normal(t) for split in SPLITS for t in templates.for_split(split)]
        assert len(set(texts)) == len(texts)
    # held-out templates of one task are in no split of another task
    train, held_out = (
        {normal(t) for task in TEXTS.tasks.values() for t in task.for_split(s)} for s in ("train", "held_out")
    )
    assert not train & held_out


def normal(template):
    return re.sub(r"[^a-z{} ]", "", template.lower().replace("into", "in").replace("please ", ""))


def test_every_template_renders_for_every_builtin_object():
    texts = []
    for name in NAMES:
        for word in (name, *WORDS.objects[name].train, *WORDS.objects[name].held_out):
            for task in TASKS:
                relation, part = "nearest" if task == "select" else None, "left door" if task == "open_pick" else ""
                slots = InstructionSlots(task, word, "cabinet", relation, part)
                found = [
                    make_instruction(slots, template_id).text
                    for split in SPLITS
                    for template_id in template_ids(task, split)
                ]
                assert all(word in text for text in found)
                texts += found
    for relation in RELATIONS:
        slots = InstructionSlots("select", "mug", "cabinet", relation)
        texts += [
            make_instruction(slots, template_id).text
            for split in SPLITS
            for template_id in template_ids("select", split)
        ]
    assert not re.search(r"[{}]|  |^ | $|,,| ,|\ban? |\bthe the\b|\bNone\b", "\n".join(texts), re.MULTILINE)


def test_relations_are_complete_and_distinct():
    assert tuple(TEXTS.relations) == RELATIONS
    phrases = [p for r in TEXTS.relations.values() for p in (r.plain, *r.train, *r.held_out)]
    assert len(set(phrases)) == len(phrases)
    assert all(r.train and r.held_out for r in TEXTS.relations.values())


def test_every_builtin_object_has_synonyms_in_both_splits():
    assert len(NAMES) == 46
    assert sorted(WORDS.objects) == NAMES
    for name, words in WORDS.objects.items():
        both = (*words.train, *words.held_out)
        assert words.train and words.held_out and len(both) <= 4
        assert len({name, *both}) == len(both) + 1


def test_no_word_could_mean_another_builtin_object():
    for (a, of_a), (b, of_b) in combinations(WORDS.objects.items(), 2):
        for x in (a, *of_a.train, *of_a.held_out):
            for y in (b, *of_b.train, *of_b.held_out):
                assert not fits_name(x, y) and not fits_name(y, x), f"{x!r} of {a}, {y!r} of {b}"


@pytest.mark.parametrize(
    ("task", "template", "match"),
    [
        ("pick", "put the thing in the basket", "object"),
        ("pick", "put the {object} on the {object}", "object"),
        ("pick", "open the {part} for the {object}", "part"),
        ("open_pick", "take the {object} out of the {support}", "part"),
        ("select", "take the {relation} {object}", "relation"),
    ],
)
def test_invalid_fields_are_errors(tmp_path, task, template, match):
    data = yaml.safe_load(INSTRUCTIONS_FILE.read_text())
    data["tasks"][task]["train"].append(template)
    path = tmp_path / "instructions.yaml"
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError, match=rf"{path}: .*fields \['{match}'\]") as caught:
        read_texts(path, InstructionTexts)
    assert "\n" not in str(caught.value)
