"""Episodes that an audit replays, and what a random sample of them shows."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from scipy.stats import hypergeom

from robocas_ms3.evaluation.results.result_files import Result

_CONFIDENCE = 0.95


def choose_episodes(
    result: Result, sample: int | None = None, seed: int = 0, stored: Collection[int] | None = None
) -> list[int]:
    """Return the numbers of the episodes to replay, in ascending order.

    Episodes that ended with an error before their first action are left out.

    Args:
        result: the result.
        sample: number of episodes to choose at random; None: all.
        seed: random seed of the choice.
        stored: numbers of the episodes whose actions are stored; None: all.
    """
    numbers = [
        number
        for number, outcome in result.outcomes.items()
        if (outcome.steps or not outcome.error) and (stored is None or number in stored)
    ]
    if sample is None or sample >= len(numbers):
        return numbers
    return sorted(np.random.default_rng(seed).choice(numbers, sample, replace=False).tolist())


def bound_differing_episodes(sample: int, total: int) -> int:
    """Return the greatest number of differing episodes that a sample without differences does not exclude.

    With at least one more among the ``total`` episodes, a random sample would show one with a probability of at least
    95 %.
    """
    differing = np.arange(total - sample + 1)
    unseen = hypergeom.pmf(0, total, differing, sample)  # probability that the sample has none of them
    return int(differing[unseen > 1 - _CONFIDENCE].max())
