"""Instructions: RoboCAS-v0's template or one of many paraphrases, with or without synonyms."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar, cast, get_args

import numpy as np

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.scenes.language.texts import Split, Templates, load_instruction_texts, load_synonym_texts
from robocas_ms3.scenes.relations import Relation
from robocas_ms3.scenes.task_specs import TASKS

if TYPE_CHECKING:
    from robocas_ms3.scenes.config import TaskConfig
    from robocas_ms3.scenes.layout import Layout

_LANGUAGE = 100  # random stream of the instruction; scenes/sample.py has the streams of layouts
SPLITS: tuple[Split, ...] = get_args(Split)

_T = TypeVar("_T")


@dataclass(frozen=True)
class InstructionSlots:
    """Values that are inserted into an instruction template, before synonyms replace them.

    Attributes:
        task: name of the task, such as ``pick``.
        object: name of the target, such as ``sugar box``.
        support: place of the objects, such as ``table``.
        relation: relation that distinguishes the target from identical objects, for tasks with the slot ``relation``.
            None: the instruction has no relation; then the nearest object is the target.
        part: part to open, such as ``left door``, for tasks with the slot ``part``; see `part_name`.

    Raises:
        RobocasError: the task is unknown, has no slot for the relation or the part, or needs a part.
    """

    task: str
    object: str
    support: str
    relation: Relation | None = None
    part: str = ""

    def __post_init__(self) -> None:
        slots = TASKS.find(self.task).slots
        if self.relation and "relation" not in slots:
            what = "instructions of this task have no relation"
            expected = f"no relation, or task {_tasks_with('relation')}"
            raise RobocasError(what, where=self.task, expected=expected, found=repr(self.relation))
        if bool(self.part) != ("part" in slots):
            what = f"instructions of this task {'need a' if 'part' in slots else 'have no'} furniture part"
            expected = "a name such as left door" if "part" in slots else f"no part, or task {_tasks_with('part')}"
            raise RobocasError(what, where=self.task, expected=expected, found=repr(self.part) if self.part else "none")


@dataclass(frozen=True)
class Instruction:
    """An instruction, with the template and the words from which it was made.

    Attributes:
        text: the instruction.
        template_id: task, split and index of the template in the list of this split, such as ``pick/train/07``. New
            templates are added at the end, so the id of a template never changes.
        split: split of template and synonyms.
        object_word: name of the target, or a synonym of it.
        support_word: name of the support, or a synonym of it. Some templates do not contain it.
        relation_phrase: phrase of the relation, such as ``closest {object}``; empty without a relation.
    """

    text: str
    template_id: str
    split: Split
    object_word: str
    support_word: str
    relation_phrase: str = ""


def make_instruction(slots: InstructionSlots, template_id: str = "") -> Instruction:
    """Return the instruction of one template, without synonyms.

    Args:
        slots: values that are inserted into the template.
        template_id: task, split and index of the template, such as ``pick/train/07``; empty: RoboCAS-v0's template.

    Raises:
        RobocasError: the template does not exist.
    """
    template_id = template_id or f"{slots.task}/upstream/00"
    for split in SPLITS:
        if template_id in (ids := template_ids(slots.task, split)):
            phrase = load_instruction_texts().relations[slots.relation].plain if slots.relation else ""
            return _render(slots, split, ids.index(template_id), (slots.object, slots.support, phrase))
    known = [ids for split in SPLITS if (ids := template_ids(slots.task, split))]
    expected = ", ".join(f"{ids[0]} to {ids[-1]}" for ids in known)
    raise RobocasError("no such instruction template", where=template_id, expected=expected)


def draw_instruction(
    rng: np.random.Generator,
    slots: InstructionSlots,
    split: Split,
    *,
    others: Iterable[str] = (),
    synonyms: bool = True,
) -> Instruction:
    """Draw an instruction: a template, and the name or a synonym for object, support and relation.

    The splits ``train`` and ``held_out`` have no template and no synonym in common. Both may use the names themselves.

    Args:
        rng: random generator, from which each call draws four numbers.
        slots: values that are inserted into the template.
        split: ``upstream`` (RoboCAS-v0's template without synonyms), ``train`` or ``held_out``.
        others: names of the other objects in the scene. A synonym that may mean one of them is not used.
        synonyms: whether synonyms may replace names and relations.

    Raises:
        RobocasError: the task has no templates of the split.
    """
    draws = rng.random(4)
    words, relation = (
        load_synonym_texts(),
        load_instruction_texts().relations[slots.relation] if slots.relation else None,
    )
    templates = _templates(slots.task, split)
    if not templates:
        known = [name for name in SPLITS if _templates(slots.task, name)]
        what = f"no instruction templates in the split {split!r}"
        raise RobocasError(what, where=f"task {slots.task}", expected=f"one of {', '.join(known)}")
    objects, supports, phrases = [slots.object], [slots.support], [relation.plain if relation else ""]
    if synonyms:
        known = words.objects[slots.object].for_split(split) if slots.object in words.objects else ()
        others = [name for name in others if name != slots.object]
        objects += [word for word in known if not any(fits_name(word, name) for name in others)]
        supports += words.supports[slots.support].for_split(split) if slots.support in words.supports else ()
        phrases += relation.for_split(split) if relation else ()
    drawn = _choose(objects, draws[1]), _choose(supports, draws[2]), _choose(phrases, draws[3])
    return _render(slots, split, _choose(range(len(templates)), draws[0]), drawn)


def episode_instruction(config: TaskConfig, layout: Layout, seed: int, name: str, names: Iterable[str]) -> Instruction:
    """Draw the instruction of an episode; equal seeds of the layout give equal instructions.

    Args:
        config: the task configuration.
        layout: layout of the episode.
        seed: seed of the layout.
        name: name of the target.
        names: names of all objects in the scene.
    """
    opening, language = config.opening, config.language
    slots = InstructionSlots(
        config.task,
        object=name,
        support=config.support,
        relation=cast("Relation | None", layout.relation or None),
        part=opening.part or part_name(opening.handle) if opening else "",
    )
    rng, others = np.random.default_rng([seed, _LANGUAGE]), sorted(set(names) - {name})
    return draw_instruction(rng, slots, language.split, others=others, synonyms=language.synonyms)


def template_ids(task: str, split: Split) -> list[str]:
    return [f"{task}/{split}/{index:02d}" for index in range(len(_templates(task, split)))]


def part_name(link: str) -> str:
    """Return the name that instructions use for a part of furniture, from the name of the handle or link.

    ``door_left`` gives 'left door' (left as seen from the front), ``freezer_door`` gives 'freezer door'.
    """
    *noun, last = link.split("_")
    sided = noun and last in {"left", "right", "top", "middle", "bottom", "upper", "lower"}
    return " ".join([last, *noun] if sided else [*noun, last])


def fits_name(word: str, name: str) -> bool:
    """Return whether all words of ``word`` are in the name of an object.

    Example: 'shampoo bottle' fits 'white shampoo bottle'.
    """
    return set(word.lower().split()) <= set(name.lower().split())


def is_plural(word: str) -> bool:
    """Return whether a word needs the pronoun 'them': 'scissors' does, 'pair of scissors' does not."""
    return word.partition(" of ")[0].split()[-1] in load_synonym_texts().plurals


def _render(slots: InstructionSlots, split: Split, index: int, words: tuple[str, str, str]) -> Instruction:
    object_word, support_word, phrase = words
    known = load_synonym_texts().supports.get(slots.support)
    text = _templates(slots.task, split)[index].format(
        object=phrase.format(object=object_word) if phrase else object_word,
        support=support_word,
        part=slots.part,
        it="them" if is_plural(object_word) else "it",
        on="in" if known and known.inside else "on",
    )
    return Instruction(text, template_ids(slots.task, split)[index], split, *words)


def _templates(task: str, split: Split) -> Sequence[str]:
    return Templates.for_task(TASKS.find(task)).for_split(split)


def _tasks_with(slot: str) -> str:
    return ", ".join(name for name, spec in TASKS.items() if slot in spec.slots)


def _choose(options: Sequence[_T], draw: float) -> _T:
    return options[int(draw * len(options))]
