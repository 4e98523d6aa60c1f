"""Sub-goals: the parts of an episode, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError


@dataclass(frozen=True)
class SubGoal:
    """A part of an episode.

    Attributes:
        goal_type: one of ``GOAL_TYPES``.
        goal_description: its text.
        first, last: range of steps, inclusive.
    """

    goal_type: str
    goal_description: str
    first: int
    last: int

    def as_json(self) -> dict[str, Any]:
        """Its form in trajectory files and in ``data_info.json``."""
        return {
            "goal_type": self.goal_type,
            "goal_range": [self.first, self.last],
            "goal_description": self.goal_description,
        }


def read_subgoals(entries: Any, where: object) -> list[SubGoal]:
    """Sub-goals of their JSON, a list of `SubGoal.as_json`.

    Raises:
        DatasetError: they are something else.
    """
    try:
        goals = []
        for entry in entries:
            first, last = entry["goal_range"]
            goals.append(SubGoal(entry["goal_type"], entry["goal_description"], first, last))
        sound = all(
            isinstance(goal.goal_type, str) and isinstance(goal.goal_description, str) and _is_range(goal)
            for goal in goals
        )
    except (KeyError, TypeError, ValueError):
        sound = False
    if not sound:
        raise DatasetError(
            "these sub-goals are damaged",
            where=where,
            expected="goal_type, goal_range [first, last], goal_description of each",
            found=str(entries)[:80],
        )
    return goals


def _is_range(goal: SubGoal) -> bool:
    return type(goal.first) is int and type(goal.last) is int and 0 <= goal.first <= goal.last


def sample_subgoals(subgoals: Sequence[SubGoal], samples: NDArray[np.int64]) -> list[SubGoal]:
    """Carry sub-goals over to the sampled steps.

    A step belongs to the sub-goal of the action that leaves its state, the last step to that of the last action; a
    sub-goal shorter than a stride may hold no step, and is left out.

    Args:
        subgoals: ranges over the actions 0..S-1, in order, without gaps.
        samples: from `motion.sample_states`.

    Returns:
        Ranges over the sampled steps, in order, without gaps.

    Raises:
        DatasetError: the ranges do not cover the actions.
    """
    actions = int(samples[-1])
    expected_first = 0
    for goal in subgoals:
        if goal.first != expected_first or goal.last < goal.first:
            break
        expected_first = goal.last + 1
    if expected_first != actions:
        raise DatasetError(
            "sub-goals do not cover the actions one after the other",
            where="subgoals",
            expected=f"ranges from 0 to {actions - 1}",
            found=[[goal.first, goal.last] for goal in subgoals],
        )
    owner = np.searchsorted([goal.first for goal in subgoals], np.minimum(samples, actions - 1), side="right") - 1
    result = []
    for index, goal in enumerate(subgoals):
        steps = np.flatnonzero(owner == index)
        if len(steps):
            result.append(SubGoal(goal.goal_type, goal.goal_description, int(steps[0]), int(steps[-1])))
    return result


def subgoal_runs(types: Sequence[str], texts: Sequence[str]) -> list[SubGoal]:
    """Sub-goals of steps that follow each other."""
    goals: list[SubGoal] = []
    for (kind, text), steps in groupby(range(len(types)), key=lambda step: (types[step], texts[step])):
        inside = list(steps)
        goals.append(SubGoal(kind, text, inside[0], inside[-1]))
    return goals
