"""How episodes are divided into training and validation."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any

from robocas_ms3.demos.recordings.trajectory_json import one_seed

SPLIT_RULE = (
    "seeds in the order of sha256(seed), the first tenth validates; episodes of one seed stay together; what is"
    " appended changes no earlier episode's side"
)


def split_by_seed(
    seed_of: Mapping[int, Any], before: tuple[Iterable[int], Iterable[int]] = ((), ())
) -> tuple[list[int], list[int]]:
    """Split episodes, number -> seed as files have it, 90 : 10; one without a seed has its number in its place.

    The place of a seed depends on no order and no generator.

    Training and validation episodes ``before`` and their seeds keep their side, and of the new seeds as many validate
    as make up a tenth of all. At least one seed validates where there are two.
    """
    known = {number: one_seed(value) for number, value in seed_of.items()}
    seeds = {number: number if seed is None else seed for number, seed in known.items()}
    old = [{seeds[number] for number in numbers if number in seeds} for numbers in before]
    ranked = sorted(set(seeds.values()), key=lambda seed: hashlib.sha256(str(seed).encode()).hexdigest())
    count = max(1, round(len(ranked) / 10)) if len(ranked) > 1 else 0
    new = [seed for seed in ranked if seed not in old[0] | old[1]]
    chosen = old[1] | set(new[: max(0, count - len(old[1]))])
    kept = set(before[0])  # an episode that trains goes on to, whatever others of its seed do
    val = sorted(number for number, seed in seeds.items() if seed in chosen and number not in kept)
    return sorted(set(seeds) - set(val)), val
