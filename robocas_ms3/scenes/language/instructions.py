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
    """The content of an instruction, in plain names.

    Attributes:
        task: name of the task, ``pick``.
        object: name of the target, ``sugar box``.
        support: place of the objects, ``table``.
        relation: relation that distinguishes the target from identical objects, if the task has this slot; None: the
            instruction has no relation, and the nearest object is the target.
        part: part that must be opened, ``left door``, if the task has this slot; see `part_name`.

    Raises:
        RobocasError: the task is unknown, the part is missing, or the task has no slot for relation or part.
    """

    task: str
    object: str
    support: str
    relation: Relation | None = None
    part: str = ""

    def __post_init__(self) -> None:
        slots = TASKS.find(self.task).slots
        if self.relation and "relation" not in slots:
            what = f"only the task {_tasks_with('relation')} may have a relation"
            raise RobocasError(what, where=self.task, expected="no relation", found=repr(self.relation))
        if bool(self.part) != ("part" in slots):
            what, found = (
                f"the task {_tasks_with('part')} needs a part, and other tasks may not have one",
                repr(self.part) if self.part else "none",
            )
            raise RobocasError(what, where=self.task, found=found)


@dataclass(frozen=True)
class Instruction:
    """An instruction with its template and words.

    Attributes:
        text: the instruction.
        template_id: task, split and index in the split's list: ``pick/train/07``. Added templates don't change it.
        split: split of the template and of the synonyms.
        object_word: name of the target or a synonym.
        support_word: name of the support or a synonym; not every template contains it.
        relation_phrase: phrase of the relation, ``closest {object}``; empty without a relation.
    """

    text: str
    template_id: str
    split: Split
    object_word: str
    support_word: str
    relation_phrase: str = ""


def make_instruction(slots: InstructionSlots, template_id: str = "") -> Instruction:
    """Return the instruction of a template with plain names; default: RoboCAS-v0's template.

    Raises:
        RobocasError: the template does not exist.
    """
    template_id = template_id or f"{slots.task}/upstream/00"
    for split in SPLITS:
        if template_id in (ids := template_ids(slots.task, split)):
            phrase = load_instruction_texts().relations[slots.relation].plain if slots.relation else ""
            return _render(slots, split, ids.index(template_id), (slots.object, slots.support, phrase))
    expected = f"{slots.task}/SPLIT/NN with SPLIT one of {list(SPLITS)}, NN below their counts"
    raise RobocasError("no such template", where=template_id, expected=expected)


def draw_instruction(
    rng: np.random.Generator,
    slots: InstructionSlots,
    split: Split,
    *,
    others: Iterable[str] = (),
    synonyms: bool = True,
) -> Instruction:
    """Draw an instruction: a template of the split, and words for object, support and relation.

    The splits ``train`` and ``held_out`` have no template and no synonym in common; both contain plain names.

    Args:
        rng: random generator; each call makes four draws.
        slots: content of the instruction.
        split: ``upstream`` (RoboCAS-v0's template with plain names), ``train`` or ``held_out``.
        others: names of the other objects in the scene; synonyms that fit one of them are not used.
        synonyms: whether synonyms may replace plain names and relations.

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
        raise RobocasError("this task has no templates of this split", where=slots.task, found=split)
    objects, supports, phrases = [slots.object], [slots.support], [relation.plain if relation else ""]
    if synonyms:
        known = words.objects[slots.object].for_split(split) if slots.object in words.objects else ()
        others = [name for name in others if name != slots.object]
        objects += [word for word in known if not any(fits_name(word, name) for name in others)]
        supports += words.supports[slots.support].for_split(split) if slots.support in words.supports else ()
        phrases += relation.for_split(split) if relation else ()
    drawn = _pick(objects, draws[1]), _pick(supports, draws[2]), _pick(phrases, draws[3])
    return _render(slots, split, _pick(range(len(templates)), draws[0]), drawn)


def episode_instruction(config: TaskConfig, layout: Layout, seed: int, name: str, names: Iterable[str]) -> Instruction:
    """Return the instruction of an episode, drawn with the seed of its layout.

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
    """Return the name of a furniture part in instructions, from the name of its link in a bundled pack.

    ``door_left`` is the 'left door', seen from the front; ``freezer_door`` is the 'freezer door'.
    """
    *noun, last = link.split("_")
    sided = noun and last in {"left", "right", "top", "middle", "bottom", "upper", "lower"}
    return " ".join([last, *noun] if sided else [*noun, last])


def fits_name(word: str, name: str) -> bool:
    """Return whether a word fits an object's name: 'shampoo bottle' fits 'white shampoo bottle'."""
    return set(word.lower().split()) <= set(name.lower().split())


def is_plural(word: str) -> bool:
    """Return whether the pronoun of a word is 'them': 'scissors', but not 'pair of scissors'."""
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


def _pick(options: Sequence[_T], draw: float) -> _T:
    return options[int(draw * len(options))]
