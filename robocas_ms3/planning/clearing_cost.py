"""Cost of the work that is left until an object can be grasped."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robocas_ms3.scenes.task_specs import MAX_HIDDEN_FRACTION, MAX_OBSTACLES

COST_PER_OBSTACLE, COST_PER_HIDDEN_FRACTION, COST_WITHOUT_GRASP = 10.0, 30.0, 8.0  # s


def compute_clearing_cost(obstacles: ArrayLike, hidden_fraction: ArrayLike, free_grasps: ArrayLike) -> Any:
    """Estimate the duration of the moves that are left until an object can be grasped, s.

    The arguments are numbers or arrays of the same shape.

    Args:
        obstacles: number of obstacles around the object.
        hidden_fraction: fraction of the object that other objects hide, seen from above; the cost of NaN is NaN.
        free_grasps: number of grasps without contact between the gripper and other objects.

    Returns:
        Cost of each object; 0 if the object is cleared by the paper's rule and has a free grasp.
    """
    cost = COST_PER_OBSTACLE * np.maximum(0, np.asarray(obstacles) - MAX_OBSTACLES)
    cost = cost + COST_PER_HIDDEN_FRACTION * np.maximum(0.0, np.asarray(hidden_fraction) - MAX_HIDDEN_FRACTION)
    return cost + COST_WITHOUT_GRASP * (np.asarray(free_grasps) <= 0)
