"""The sub-goals of episodes: their types and texts."""

from __future__ import annotations

SUBGOALS = {
    # texts of RoboCAS-v0
    "find the object": "find the {object} on the {support}",
    "operate the target": "open the {support}",
    "move and grasp": "grasp the {object} on the {support}",
    "transfer object": "Drop the {object} into the basket",
    # additional texts of this package
    "grasp object": "grasp the {object}",
    "release object": "release the {object}",
    "lift object": "lift the {object}",
    "grasp and lift the object": "grasp and lift the {object}",
}
GOAL_TYPES = tuple(SUBGOALS)


def subgoal(goal_type: str, object: str, support: str) -> dict[str, str]:
    """Return the ``goal_type`` and ``goal_description`` of a sub-goal, as recorded in episodes.

    Args:
        goal_type: one of ``GOAL_TYPES``.
        object: the target's plain name.
        support: plain name of the support, or of the furniture that is opened.
    """
    return {"goal_type": goal_type, "goal_description": SUBGOALS[goal_type].format(object=object, support=support)}
