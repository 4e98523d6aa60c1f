"""The relations by which an instruction names one of several identical objects."""

from __future__ import annotations

from typing import Literal, get_args

Relation = Literal[
    "nearest",
    "second_nearest",
    "farthest",
    "leftmost",
    "second_from_left",
    "middle",
    "second_from_right",
    "rightmost",
]
"""All from the robot's point of view.

``nearest``, ``second_nearest`` and ``farthest`` order the objects by their horizontal distance from the robot;
the others order them from the robot's left to its right, where ``middle`` needs an odd number of them.
"""

RELATIONS: tuple[Relation, ...] = get_args(Relation)
NEED_THREE: tuple[Relation, ...] = ("second_nearest", "second_from_left", "middle", "second_from_right")
"""Those that say nothing of two objects."""
