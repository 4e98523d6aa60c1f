"""``data_info.json``: what is in a dataset, and how it splits into training and validation."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets.episode import SubGoal

SPLIT_RULE = "seeds in the order of sha256(seed), the first tenth validates; episodes of one seed stay together"


def split_by_seed(seeds: Mapping[int, int]) -> tuple[list[int], list[int]]:
    """Split episodes 90 : 10. A seed's place depends on no order and no generator, only on the other seeds.

    Args:
        seeds: episode number -> seed.

    Returns:
        Training and validation episodes, sorted. At least one seed validates where there are two.
    """
    ranked = sorted(set(seeds.values()), key=lambda seed: hashlib.sha256(str(seed).encode()).hexdigest())
    count = max(1, round(len(ranked) / 10)) if len(ranked) > 1 else 0
    chosen = set(ranked[:count])
    val = sorted(number for number, seed in seeds.items() if seed in chosen)
    return sorted(set(seeds) - set(val)), val


def action_space(rel_pos: Sequence[NDArray], rel_orn: Sequence[NDArray]) -> dict[str, list[list[float]]]:
    """Range of the relative motions: 1st and 99th percentile of each axis over all episodes.

    Args:
        rel_pos: (T, 3) of each episode; the last row, which is no motion, does not count.
        rel_orn: (T, 4) xyzw of each episode.
    """
    positions = np.concatenate([rows[:-1] for rows in rel_pos]).astype(np.float64)
    quaternions = np.concatenate([rows[:-1] for rows in rel_orn]).astype(np.float64)
    angles = Rotation.from_quat(quaternions).as_euler("xyz")
    return {
        "relative_position": np.percentile(positions, [1, 99], axis=0).tolist(),
        "relative_rotation": np.percentile(angles, [1, 99], axis=0).tolist(),
    }


def data_info(
    seeds: Mapping[int, int],
    lengths: Mapping[int, int],
    instructions: Mapping[int, str],
    subgoals: Mapping[int, Sequence[SubGoal]],
    ranges: dict[str, list[list[float]]],
) -> dict[str, Any]:
    """Content of ``data_info.json``; the mappings are by episode number."""
    train, val = split_by_seed(seeds)
    return {
        "train_eps": train,
        "val_eps": val,
        "ep_length": {str(number): length for number, length in lengths.items()},
        "language_goal": {str(number): text for number, text in instructions.items()},
        "step_goals": {str(number): [goal.as_json() for goal in goals] for number, goals in subgoals.items()},
        "action_space": ranges,
    }
