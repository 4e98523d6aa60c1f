"""Say what a task asks for: upstream's words, or one of many paraphrases, with or without synonyms."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar, get_args

import numpy as np

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.scenes.config.relations import Relation
from robocas_ms3.scenes.language.texts import Split, Templates, instruction_texts, synonym_texts
from robocas_ms3.scenes.task_specs import TASKS

SPLITS: tuple[Split, ...] = get_args(Split)

_T = TypeVar("_T")


@dataclass(frozen=True)
class Instruction:
    """An instruction, and what it was made of.

    Attributes:
        text: what the robot is told.
        template_id: task, split and place in the split's list: ``pick/train/07``. It stays when templates are added.
        split: of the template, and of synonyms.
        object_word: what the target is called: its name or a synonym.
        support_word: the same of the support; the template need not mention it.
        relation_phrase: how the relation is said, ``closest {object}``; none where there is none.
    """

    text: str
    template_id: str
    split: Split
    object_word: str
    support_word: str
    relation_phrase: str = ""


def instruction(
    task: str,
    *,
    object: str,
    support: str,
    relation: Relation | None = None,
    part: str = "",
    template_id: str = "",
) -> Instruction:
    """Tell the robot what to do, in plain names.

    Args:
        task: its name, pick.
        object: the target's name, 'sugar box'.
        support: what the objects are on or in, 'table'.
        relation: where the task has that slot: which one of several identical objects; none: the nearest, which
            upstream does not say.
        part: where the task has that slot: what has to be opened, 'left door'; see ``part_name``.
        template_id: of the template; none: upstream's.

    Raises:
        RobocasError: no such template, part missing, or relation or part out of place.
    """
    template_id = template_id or f"{task}/upstream/00"
    for split in SPLITS:
        if template_id in (ids := template_ids(task, split)):
            template = _templates(task, split)[ids.index(template_id)]
            phrase = instruction_texts().relations[relation].plain if relation else ""
            return _render(task, split, template_id, template, object, support, _on(support), phrase, part)
    raise RobocasError(
        "no such template",
        where=template_id,
        expected=f"{task}/SPLIT/NN with SPLIT one of {list(SPLITS)}, NN below their counts",
    )


def choose_instruction(
    rng: np.random.Generator,
    task: str,
    split: Split,
    *,
    object: str,
    support: str,
    relation: Relation | None = None,
    part: str = "",
    others: Iterable[str] = (),
    synonyms: bool = True,
) -> Instruction:
    """Draw an instruction: a template of the split, then the target's name or one of its synonyms in the split.

    The words for support and relation are drawn likewise. Held-out texts so never meet train's templates or synonyms;
    plain names are in both.

    Args:
        rng: moved on by four draws, whatever the arguments.
        task: as in ``instruction``.
        split: ``upstream`` (its template, plain names), ``train`` or ``held_out``.
        object: as in ``instruction``.
        support: as in ``instruction``.
        relation: as in ``instruction``.
        part: as in ``instruction``.
        others: names of the other objects in the scene; synonyms that could mean one of them are left out.
        synonyms: False: the plain names and plain relations in every template.

    Raises:
        RobocasError: part missing, or relation or part out of place; or the task has no templates of the split.
    """
    draws = rng.random(4)
    texts, words = instruction_texts(), synonym_texts()
    templates = _templates(task, split)
    if not templates:
        raise RobocasError("this task has no templates of this split", where=task, found=split)
    index = _pick(range(len(templates)), draws[0])
    others = [name for name in others if name != object]
    object_words, support_words, phrases = [object], [support], [texts.relations[relation].plain] if relation else [""]
    if synonyms:
        known = words.objects[object].of(split) if object in words.objects else ()
        object_words += [word for word in known if not any(could_mean(word, name) for name in others)]
        support_words += words.supports[support].of(split) if support in words.supports else ()
        phrases += texts.relations[relation].of(split) if relation else ()
    return _render(
        task,
        split,
        _template_id(task, split, index),
        templates[index],
        _pick(object_words, draws[1]),
        _pick(support_words, draws[2]),
        _on(support),
        _pick(phrases, draws[3]),
        part,
    )


def template_ids(task: str, split: Split) -> list[str]:
    """Ids of the templates of a split, in order."""
    return [_template_id(task, split, index) for index in range(len(_templates(task, split)))]


def _templates(task: str, split: Split) -> Sequence[str]:
    return Templates.for_task(TASKS.find(task)).of(split)


def part_name(link: str) -> str:
    """What to call a part of furniture that is named as the builtin ones are.

    ``door_left`` is the 'left door', as seen by who stands before it; ``freezer_door`` the 'freezer door'.
    """
    *noun, last = link.split("_")
    sided = noun and last in {"left", "right", "top", "middle", "bottom", "upper", "lower"}
    return " ".join([last, *noun] if sided else [*noun, last])


def could_mean(word: str, name: str) -> bool:
    """Whether a word fits an object of that name: 'shampoo bottle' fits the 'white shampoo bottle'."""
    return set(word.lower().split()) <= set(name.lower().split())


def is_plural(word: str) -> bool:
    """Whether a thing is 'them': 'scissors', but not a 'pair of scissors'."""
    return word.partition(" of ")[0].split()[-1] in synonym_texts().plurals


def _render(
    task: str,
    split: Split,
    template_id: str,
    template: str,
    object_word: str,
    support_word: str,
    on: str,
    phrase: str,
    part: str,
) -> Instruction:
    slots = TASKS[task].slots
    if phrase and "relation" not in slots:
        what = f"the task {_with('relation')}, and no other, may have a relation"
        raise RobocasError(what, where=task, found=repr(phrase))
    if bool(part) != ("part" in slots):
        found = repr(part) if part else "none"
        raise RobocasError(f"the task {_with('part')}, and no other, needs a part", where=task, found=found)
    text = template.format(
        object=phrase.format(object=object_word) if phrase else object_word,
        support=support_word,
        part=part,
        it="them" if is_plural(object_word) else "it",
        on=on,
    )
    return Instruction(text, template_id, split, object_word, support_word, phrase)


def _with(slot: str) -> str:
    return ", ".join(name for name, spec in TASKS.items() if slot in spec.slots)


def _on(support: str) -> str:
    known = synonym_texts().supports.get(support)
    return "in" if known and known.inside else "on"


def _template_id(task: str, split: Split, index: int) -> str:
    return f"{task}/{split}/{index:02d}"


def _pick(options: Sequence[_T], draw: float) -> _T:
    return options[int(draw * len(options))]
