"""How episodes are divided into training and validation."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping

SPLIT_RULE = (
    "seeds in the order of sha256(seed), the first tenth validates; episodes of one seed stay together; what is"
    " appended changes no earlier episode's side"
)


def split_by_seed(
    seeds: Mapping[int, int], before: tuple[Iterable[int], Iterable[int]] = ((), ())
) -> tuple[list[int], list[int]]:
    """Split episodes, number -> seed, 90 : 10; a seed's place depends on no order and no generator.

    Training and validation episodes ``before`` and their seeds keep their side, and of the new seeds as many validate
    as make up a tenth of all. At least one seed validates where there are two.
    """
    old = [{seeds[number] for number in numbers if number in seeds} for numbers in before]
    ranked = sorted(set(seeds.values()), key=lambda seed: hashlib.sha256(str(seed).encode()).hexdigest())
    count = max(1, round(len(ranked) / 10)) if len(ranked) > 1 else 0
    new = [seed for seed in ranked if seed not in old[0] | old[1]]
    chosen = old[1] | set(new[: max(0, count - len(old[1]))])
    kept = set(before[0])  # an episode that trains goes on to, whatever others of its seed do
    val = sorted(number for number, seed in seeds.items() if seed in chosen and number not in kept)
    return sorted(set(seeds) - set(val)), val
