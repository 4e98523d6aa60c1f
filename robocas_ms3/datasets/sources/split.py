"""Split of episodes into training and validation."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any

from robocas_ms3.demos.recordings.trajectory_json import parse_seed

SPLIT_RULE = (
    "seeds in the order of sha256(seed), the first tenth is for validation; episodes of one seed stay together;"
    " appended episodes do not change the split of earlier ones"
)


def split_by_seed(
    seed_by_episode: Mapping[int, Any], previous: tuple[Iterable[int], Iterable[int]] = ((), ())
) -> tuple[list[int], list[int]]:
    """Split episodes by seed; return the numbers of the training and validation episodes.

    90 % of the seeds are for training, 10 % for validation. The split depends on the seeds alone, not on their order.
    Without ``previous``, two or more seeds give at least one validation seed.

    Args:
        seed_by_episode: number of an episode -> its seed; for None, the number is the seed.
        previous: training and validation episodes of an earlier split. They keep their split, and so do other episodes
            with the same seeds. New seeds are added to validation until it has a tenth of all seeds.
    """
    known = {number: parse_seed(value) for number, value in seed_by_episode.items()}
    seeds = {number: number if seed is None else seed for number, seed in known.items()}
    old = [{seeds[number] for number in numbers if number in seeds} for numbers in previous]
    ranked = sorted(set(seeds.values()), key=lambda seed: hashlib.sha256(str(seed).encode()).hexdigest())
    count = max(1, round(len(ranked) / 10)) if len(ranked) > 1 else 0
    new = [seed for seed in ranked if seed not in old[0] | old[1]]
    chosen = old[1] | set(new[: max(0, count - len(old[1]))])
    kept = set(previous[0])  # a training episode stays, even if its seed is for validation
    val = sorted(number for number, seed in seeds.items() if seed in chosen and number not in kept)
    return sorted(set(seeds) - set(val)), val
