"""Instructions for objects that are not the target of the episode."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.scenes.config.task import TaskConfig
from robocas_ms3.scenes.language.instructions import InstructionSlots, draw_instruction, part_name
from robocas_ms3.scenes.relations import Relation, select_by_relation
from robocas_ms3.scenes.task_specs import TASKS


def find_relations(
    config: TaskConfig, names: NDArray[np.str_], xy_in_base: NDArray, slot: int
) -> list[Relation | None]:
    """Return the relations with which an instruction can name an object.

    Args:
        config: task configuration.
        names: (K,) names of the objects; an empty text without an object.
        xy_in_base: (K, 2) positions of the objects in the arm's base frame, m.
        slot: slot of the object.

    Returns:
        ``[None]`` if the name is unique; relations that distinguish the object from those of the same name if the task
        has relations; otherwise an empty list.
    """
    peers = np.flatnonzero(names == names[slot])
    if len(peers) == 1:
        return [None]
    if "relation" not in TASKS[config.task].slots:
        return []
    index, xy = int(np.searchsorted(peers, slot)), xy_in_base[peers].astype(np.float64)
    return [relation for relation in config.target.relations if select_by_relation(relation, xy) == index]


def draw_target_instruction(
    config: TaskConfig, names: NDArray[np.str_], slot: int, relation: Relation | None, rng: np.random.Generator
) -> str:
    """Draw an instruction for an object, from the templates of the task that its configuration uses.

    Args:
        config: task configuration.
        names: (K,) names of the objects; an empty text without an object.
        slot: slot of the object.
        relation: one of `find_relations`.
        rng: random generator.
    """
    part = (config.opening.part or part_name(config.opening.handle)) if config.opening else ""
    slots = InstructionSlots(config.task, str(names[slot]), config.support, relation, part)
    others = sorted({str(name) for name in names if name} - {str(names[slot])})
    language = config.language
    return draw_instruction(rng, slots, language.split, others=others, synonyms=language.synonyms).text
