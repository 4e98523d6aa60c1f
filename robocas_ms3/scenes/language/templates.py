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


def make_subgoal(goal_type: str, object: str, support: str) -> dict[str, str]:
    """Return a sub-goal as episodes record it: a dict with ``goal_type`` and ``goal_description``.

    Args:
        goal_type: one of ``GOAL_TYPES``.
        object: name of the target.
        support: name of the place of the objects, or of the furniture that is opened.
    """
    return {"goal_type": goal_type, "goal_description": SUBGOALS[goal_type].format(object=object, support=support)}
