"""The relations by which an instruction names one of several identical objects, seen from the robot."""

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
"""The first three order objects by horizontal distance, the others from left to right."""

RELATIONS: tuple[Relation, ...] = get_args(Relation)
THREE_OBJECT_RELATIONS: tuple[Relation, ...] = ("second_nearest", "second_from_left", "middle", "second_from_right")
"""Relations that need at least three objects."""
MARGIN = 0.03  # m by which the named object differs from every other in what the relation compares


def select_by_relation(relation: Relation, xy_in_robot: NDArray[np.float64]) -> int | None:
    """Return the index of the object that a relation names; None where the answer is not clear by `MARGIN`.

    Args:
        relation: how the instruction names it.
        xy_in_robot: (n, 2) m, centres of the identical objects in the robot's frame: x ahead, y to its left.
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
    return int(chosen) if np.abs(np.delete(key, chosen) - key[chosen]).min() >= MARGIN else None
