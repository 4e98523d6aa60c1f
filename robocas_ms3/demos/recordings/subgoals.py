"""Sub-goals of an episode, with a text for each."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, model_validator

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.strict_model import parse


class SubGoal(BaseModel):
    """Sub-goal of an episode in trajectory files and ``data_info.json``.

    Attributes:
        goal_type: type of the sub-goal, e.g. ``transfer object``.
        goal_range: indices of the first and the last action (trajectory file) or step (dataset).
        goal_description: sub-goal as a sentence.
    """

    model_config = ConfigDict(strict=True, extra="allow", frozen=True)

    goal_type: str
    goal_range: Annotated[list[NonNegativeInt], Field(min_length=2, max_length=2)]
    goal_description: str

    @classmethod
    def from_range(cls, goal_type: str, goal_description: str, first: int, last: int) -> SubGoal:
        return cls(goal_type=goal_type, goal_range=[first, last], goal_description=goal_description)

    @property
    def first(self) -> int:
        """Index of the first action or step."""
        return self.goal_range[0]

    @property
    def last(self) -> int:
        """Index of the last action or step."""
        return self.goal_range[1]

    @model_validator(mode="after")
    def _check_range(self) -> SubGoal:
        if self.first > self.last:
            raise ValueError(f"goal_range: expected [first, last] with first <= last, found {self.goal_range}")
        return self


class SubGoals(BaseModel):
    """JSON object with the sub-goals of an episode."""

    model_config = ConfigDict(strict=True, extra="allow", frozen=True)

    subgoals: list[SubGoal]


def read_subgoals(entries: Any, where: object) -> list[SubGoal]:
    return parse(SubGoals, {"subgoals": entries}, DatasetError, where=where, about="invalid sub-goals").subgoals


def sample_subgoals(subgoals: Sequence[SubGoal], samples: NDArray[np.int64]) -> list[SubGoal]:
    """Convert sub-goals with ranges of actions to sub-goals with ranges of dataset steps.

    A step has the sub-goal of the action after its state; the last step has the sub-goal of the last action. A sub-goal
    that contains no step is omitted.

    Args:
        subgoals: sub-goals of an episode, with ranges of actions.
        samples: (T,) indices of the sampled states from `motion.sample_states`.

    Raises:
        DatasetError: the ranges do not cover all actions in order.
    """
    actions = int(samples[-1])
    expected_first = 0
    for goal in subgoals:
        if goal.first != expected_first:
            break
        expected_first = goal.last + 1
    if expected_first != actions:
        raise DatasetError(
            "sub-goals do not cover the actions",
            where="subgoals",
            expected=f"contiguous ranges from 0 to {actions - 1}",
            found=[goal.goal_range for goal in subgoals],
        )
    owner = np.searchsorted([goal.first for goal in subgoals], np.minimum(samples, actions - 1), side="right") - 1
    result = []
    for index, goal in enumerate(subgoals):
        steps = np.flatnonzero(owner == index)
        if len(steps):
            result.append(SubGoal.from_range(goal.goal_type, goal.goal_description, int(steps[0]), int(steps[-1])))
    return result


def group_subgoals(types: Sequence[str], texts: Sequence[str]) -> list[SubGoal]:
    """Group consecutive steps with equal type and text to one sub-goal each.

    Args:
        types: type of the sub-goal of each step.
        texts: text of the sub-goal of each step.
    """
    goals: list[SubGoal] = []
    for (kind, text), steps in groupby(range(len(types)), key=lambda step: (types[step], texts[step])):
        inside = list(steps)
        goals.append(SubGoal.from_range(kind, text, inside[0], inside[-1]))
    return goals
