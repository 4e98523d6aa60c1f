"""Ranks of policies by paired tests over the same episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

from robocas_ms3.evaluation.statistics import adjust_p_values, compare_successes

ALPHA = 0.05


class Rank(NamedTuple):
    """Rank of a policy.

    Attributes:
        rank: 1 plus the number of policies with significantly more successes, so that ties have equal ranks.
        p_value: adjusted p-value of the comparison with the next policy in the order of success rates; None: it is the
            last one, or there are no common episodes.
    """

    rank: int
    p_value: float | None


def rank_policies(successes: Sequence[Mapping[int, bool]]) -> list[Rank]:
    """Return the rank of each policy.

    All pairs are compared over their common episodes by McNemar's exact test. Holm's method adjusts the p-values, so
    that the probability of any wrong difference is at most 5 %.

    Args:
        successes: for each policy, in descending order of success rates, whether each episode succeeded.
    """
    pairs, p_values, better = [], [], []
    for first, second in combinations(range(len(successes)), 2):
        common = sorted(successes[first].keys() & successes[second].keys())
        if common:
            a, b = ([successes[number][episode] for episode in common] for number in (first, second))
            found = compare_successes(a, b)
            pairs.append((first, second))
            p_values.append(found.p_value)
            better.append((first, second) if found.difference > 0 else (second, first))
    adjusted = dict(zip(pairs, adjust_p_values(p_values), strict=True)) if pairs else {}
    beaten = [0] * len(successes)
    for pair, (_, loser) in zip(pairs, better, strict=True):
        beaten[loser] += adjusted[pair] <= ALPHA
    return [Rank(1 + count, adjusted.get((place, place + 1))) for place, count in enumerate(beaten)]
