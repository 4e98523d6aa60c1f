"""The texts of RoboCAS: upstream's only templates, word for word."""

from __future__ import annotations

from typing import Literal, get_args

GoalType = Literal[
    "find the object",
    "operate the target",
    "move and grasp",
    "transfer object",
    "grasp object",
    "release object",
    "lift object",
    "grasp and lift the object",
]

GOAL_TYPES: tuple[GoalType, ...] = get_args(GoalType)
"""Every type a sub-goal may have."""

PICK = "grasp the {object} on the {support} and move it to the basket"
"""Instruction of the tasks pick and select."""

SEARCH = "search the {object} from the objects on the {support} and transfer it to the basket"
"""Instruction of the task search."""

SUBGOALS: dict[GoalType, str] = {
    "find the object": "find the {object} on the {support}",
    "operate the target": "open the {support}",
    "move and grasp": "grasp the {object} on the {support}",
    "transfer object": "Drop the {object} into the basket",
}
"""Upstream's text of each sub-goal type that has one; the other types are labels without a text of their own."""


def pick_instruction(object: str, support: str) -> str:
    """Tell the robot to pick.

    Args:
        object: the target's name, 'sugar box'.
        support: what the objects are on, 'table'.
    """
    return PICK.format(object=object, support=support)


def search_instruction(object: str, support: str) -> str:
    """Tell the robot to search for a hidden target; arguments as of ``pick_instruction``."""
    return SEARCH.format(object=object, support=support)


def subgoal(goal_type: GoalType, object: str, support: str) -> dict[str, str]:
    """Describe one part of an episode.

    Args:
        goal_type: a key of ``SUBGOALS``.
        object: the target's name.
        support: what the objects are on, or the furniture that is opened.

    Returns:
        ``goal_type`` and ``goal_description``, as episodes record them.

    Raises:
        KeyError: the type has no text of its own.
    """
    return {"goal_type": goal_type, "goal_description": SUBGOALS[goal_type].format(object=object, support=support)}
