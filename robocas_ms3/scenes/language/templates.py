"""The sub-goals of episodes: their types and texts."""

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

SUBGOALS: dict[GoalType, str] = {
    "find the object": "find the {object} on the {support}",
    "operate the target": "open the {support}",
    "move and grasp": "grasp the {object} on the {support}",
    "transfer object": "Drop the {object} into the basket",
    "grasp object": "grasp the {object}",
    "release object": "release the {object}",
    "lift object": "lift the {object}",
    "grasp and lift the object": "grasp and lift the {object}",
}
"""The text of each type. The first four are upstream's, word for word; it has none for the others, which are ours."""


def subgoal(goal_type: GoalType, object: str, support: str) -> dict[str, str]:
    """Describe one part of an episode.

    Args:
        goal_type: one of ``GOAL_TYPES``.
        object: the target's name, plain: synonyms are for instructions.
        support: what the objects are on, or the furniture that is opened.

    Returns:
        ``goal_type`` and ``goal_description``, as episodes record them.
    """
    return {"goal_type": goal_type, "goal_description": SUBGOALS[goal_type].format(object=object, support=support)}
