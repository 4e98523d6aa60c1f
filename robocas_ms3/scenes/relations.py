"""Which of several identical objects a relation names, seen from the robot. Pure maths."""

from __future__ import annotations

import numpy as np

from robocas_ms3.scenes.config.relations import Relation
from robocas_ms3.scenes.placement import Array

MARGIN = 0.03  # m by which the named object differs from every other in what the relation compares


def related(relation: Relation, xy_in_robot: Array, *, margin: float = MARGIN) -> int | None:
    """Find the object that a relation names.

    Args:
        relation: how the instruction names it.
        xy_in_robot: (n, 2) m, centres of the identical objects in the robot's frame: x ahead, y to its left.
        margin: m.

    Returns:
        Index of the object; None where the relation has no or no clear answer.
    """
    points = np.asarray(xy_in_robot, dtype=np.float64)
    by_distance = relation in {"nearest", "second_nearest", "farthest"}
    key = np.linalg.norm(points, axis=1) if by_distance else -points[:, 1]
    order = np.argsort(key, kind="stable")
    count = len(order)
    if count < 2:
        return None
    place = {
        "nearest": 0,
        "second_nearest": 1,
        "farthest": count - 1,
        "leftmost": 0,
        "second_from_left": 1,
        "middle": count // 2 if count % 2 else count,
        "second_from_right": count - 2,
        "rightmost": count - 1,
    }[relation]
    if place >= count or (relation.startswith("second") and count < 3):
        return None
    chosen = order[place]
    others = np.delete(key, chosen)
    return int(chosen) if np.abs(others - key[chosen]).min() >= margin else None
