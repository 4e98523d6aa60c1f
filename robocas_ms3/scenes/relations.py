"""Relations that distinguish one of several identical objects in an instruction, seen from the robot."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

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
"""The first three compare horizontal distances, the others positions from left to right."""

RELATIONS: tuple[Relation, ...] = get_args(Relation)
THREE_OBJECT_RELATIONS: tuple[Relation, ...] = ("second_nearest", "second_from_left", "middle", "second_from_right")
"""Relations that need at least three objects."""
MARGIN = 0.03  # m, least difference between the named object and every other in the compared quantity


def select_by_relation(relation: Relation, xy_in_robot: NDArray[np.float64], margin: float = MARGIN) -> int | None:
    """Return the index of the object to which a relation refers.

    Args:
        relation: relation of the instruction, such as ``leftmost``.
        xy_in_robot: (n, 2) centres of n identical objects in the robot's frame, m: x forward, y left.
        margin: least difference between the named object and every other in the compared quantity, m.

    Returns:
        Index of the object. None if there are too few objects, or if another object is closer than ``margin`` in the
        compared quantity.
    """
    by_distance = relation in {"nearest", "second_nearest", "farthest"}
    key = np.linalg.norm(xy_in_robot, axis=1) if by_distance else -xy_in_robot[:, 1]
    order = np.argsort(key, kind="stable")
    count = len(order)
    if count < (3 if relation in THREE_OBJECT_RELATIONS else 2) or (relation == "middle" and count % 2 == 0):
        return None
    place = {
        "nearest": 0,
        "second_nearest": 1,
        "farthest": -1,
        "leftmost": 0,
        "second_from_left": 1,
        "middle": count // 2,
        "second_from_right": -2,
        "rightmost": -1,
    }[relation]
    chosen = order[place]
    return int(chosen) if np.abs(np.delete(key, chosen) - key[chosen]).min() >= margin else None
