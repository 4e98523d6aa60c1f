"""Numbers that describe the clutter around the target of a scene."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.demos.difficulty.records import SceneDifficulty

FEATURES: tuple[str, ...] = (
    "removals",
    "hidden_fraction",
    "no_free_grasp",
    "fewest_blockers",
    "obstacles",
    "closeness",
)
"""Names of the features; each one grows with the clutter.

- removals: smallest number of removals.
- hidden_fraction: fraction of the target that other objects hide, seen from above.
- no_free_grasp: 1 / (1 + number of free grasps).
- fewest_blockers: smallest number of objects that block a grasp.
- obstacles: number of obstacles around the target.
- closeness: mean of 1 - gap / 0.1 m over the nearest objects, at least 0.
"""
_CLOSE = 0.1  # m, gap from which an object does not count as close


def make_features(scenes: Iterable[SceneDifficulty]) -> NDArray[np.float64]:
    """Return the features (S, F) of S scenes in the order of `FEATURES`.

    The removals of a scene are NaN if their number is not known.
    """
    rows = [
        (
            np.nan if scene.removals is None else scene.removals,
            1 - scene.visible_fraction,
            1 / (1 + scene.free_grasps),
            scene.fewest_blockers,
            scene.obstacles,
            max(0.0, 1 - scene.gap / _CLOSE),
        )
        for scene in scenes
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, len(FEATURES))
