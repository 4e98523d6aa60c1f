"""Statistics of success counts: intervals of rates, paired comparisons over the same scenes, their power, and bins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import root_scalar
from scipy.stats import beta, binom, norm

_TAIL = (1 - 0.95) / 2  # error at each end of an interval
_POWER = 0.8


@dataclass(frozen=True)
class SuccessRate:
    """A success rate, k of n, and the limits of its 95 % interval, 0..1."""

    k: int
    n: int
    low: float
    high: float

    @property
    def rate(self) -> float:
        return self.k / self.n


@dataclass(frozen=True)
class Comparison:
    """Two runs, A and B, over the same scenes.

    Attributes:
        both, only_a, only_b, neither: numbers of scenes in which these succeeded.
        p_value: two-sided, of the hypothesis that A and B succeed equally often (`mcnemar`).
        low, high: limits of the 95 % interval of A's rate less B's, -1..1 (`paired_interval`).
    """

    both: int
    only_a: int
    only_b: int
    neither: int
    p_value: float
    low: float
    high: float

    @classmethod
    def from_counts(cls, both: int, only_a: int, only_b: int, neither: int) -> Comparison:
        limits = paired_interval(only_a, only_b, both + only_a + only_b + neither)
        return cls(both, only_a, only_b, neither, mcnemar(only_a, only_b), *limits)

    @property
    def n(self) -> int:
        return self.both + self.only_a + self.only_b + self.neither

    @property
    def successes_a(self) -> int:
        return self.both + self.only_a

    @property
    def successes_b(self) -> int:
        return self.both + self.only_b

    @property
    def difference(self) -> float:
        """A's rate less B's, -1..1."""
        return (self.only_a - self.only_b) / self.n


def success_rate(k: int, n: int) -> SuccessRate:
    """Return a rate with its exact interval, which holds the true rate in at least 95 % of all evaluations.

    Clopper and Pearson, Biometrika 26 (1934) 404-413, by quantiles of beta distributions. At k = 0 the lower limit
    is 0, at k = n the upper limit is 1; the other limit keeps half of the error.
    """
    low = float(beta.ppf(_TAIL, k, n - k + 1)) if k else 0.0
    high = float(beta.isf(_TAIL, k + 1, n - k)) if k < n else 1.0
    return SuccessRate(k, n, low, high)


def mcnemar(only_a: int, only_b: int) -> float:
    """Return the exact two-sided p-value of two runs over the same scenes; 1 if they disagree in no scene.

    McNemar, Psychometrika 12 (1947) 153-157, exact form: with equal rates, a scene that only one run solves is A's with
    probability 1/2, so the p-value is twice the binomial tail of the smaller count, at most 1.
    """
    return min(1.0, 2 * float(binom.cdf(min(only_a, only_b), only_a + only_b, 0.5)))


def paired_interval(only_a: int, only_b: int, n: int) -> tuple[float, float]:
    """Return Tango's score interval of the difference of two rates over the same n scenes, A's less B's.

    The differences d that the score test of paired data does not reject (Tango, Statistics in Medicine 17 (1998)
    891-908):

        |only_a - only_b - n d| <= z sqrt(n (2 q + d (1 - d)))

    where q is the likeliest probability of a scene that only B solves, given d. It stays within -1..1 and has a width
    if the runs disagree in no scene. With 6 to 50 scenes at 95 % it holds the true difference in 95 % of cases or more
    on average over the truths, in 94 % or more for 19 of 20 truths, and in 89 % at worst from 9 scenes on (83 % below);
    the worst are runs that disagree nearly everywhere. The score test is approximate: if the exact p-value is a little
    above 0.05, the interval can exclude 0. Claims go by the p-value.
    """
    z2 = float(norm.isf(_TAIL)) ** 2
    middle = (only_a - only_b) / n

    def excess(d: float) -> float:
        if d == middle:
            return -1.0  # it is 0 there if the variance is, which is no limit of the interval
        # q solves 2 n q^2 + linear q - only_b d (1 - d) = 0
        linear = (2 * n - only_a + only_b) * d - only_a - only_b
        q = (np.sqrt(max(0.0, linear**2 + 8 * n * only_b * d * (1 - d))) - linear) / (4 * n)
        return (only_a - only_b - n * d) ** 2 - z2 * n * (2 * q + d * (1 - d))

    low, high = (
        float(root_scalar(excess, bracket=(middle, end), xtol=1e-14).root) if middle != end else end
        for end in (-1.0, 1.0)
    )
    return low, high


def compare(a: ArrayLike, b: ArrayLike) -> Comparison:
    """Compare two runs by whether each succeeded in each scene, (n,) bool each, in the same order of scenes."""
    a, b = np.asarray(a, dtype=bool), np.asarray(b, dtype=bool)
    return Comparison.from_counts(*(int(cases.sum()) for cases in (a & b, a & ~b, ~a & b, ~a & ~b)))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return the p-values of several comparisons, adjusted, in their order.

    Claiming a difference where they are at most alpha makes any false claim with probability at most alpha. The i-th
    smallest of m is multiplied by m - i + 1, and is no less than those before it (Holm, Scandinavian Journal of
    Statistics 6 (1979) 65-70).
    """
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)))
    return adjusted.tolist()


def success_rates_by_bin(values: ArrayLike, successes: ArrayLike, edges: Sequence[float]) -> list[SuccessRate | None]:
    """Return success rates over bins of a number that each episode has, such as p_vis; None: an empty bin.

    Args:
        values: (n,) the numbers, within the outermost edges.
        successes: (n,) bool.
        edges: (bins + 1,) ascending; a bin holds its lower edge, the last one also its upper edge.
    """
    done, ends = np.asarray(successes, dtype=bool), np.asarray(edges, dtype=float)
    place = np.minimum(np.searchsorted(ends, np.asarray(values), side="right") - 1, len(ends) - 2)
    groups = [done[place == number] for number in range(len(ends) - 1)]
    return [success_rate(int(group.sum()), group.size) if group.size else None for group in groups]


def mcnemar_power(n: int, difference: float, discordant: float, *, alpha: float = 0.05) -> float:
    """Return the probability that the exact McNemar test tells two runs over the same n scenes apart.

    Summed exactly over the number of scenes in which the runs disagree, and over which run solves them.

    Args:
        n: number of scenes.
        difference: of the true rates, 0..1.
        discordant: the probability that the runs disagree in a scene, at least ``difference``.
        alpha: they are told apart if the p-value is at most this.
    """
    m = np.arange(1, n + 1)  # scenes in which they disagree
    # The largest count of the weaker run that is told apart; -1 if none is.
    most = binom.ppf(alpha / 2, m, 0.5)
    most = np.where(binom.cdf(most, m, 0.5) <= alpha / 2, most, most - 1)
    better = (1 + difference / discordant) / 2 if discordant else 0.5
    detected = binom.cdf(most, m, 1 - better) + binom.cdf(most, m, better)
    return float(binom.pmf(m, n, discordant) @ detected)


def smallest_paired_difference(n: int, discordant: float, *, alpha: float = 0.05) -> float | None:
    """Return the smallest difference of rates that two runs over the same n scenes show with a probability of 80 %.

    None if n is too small for any: six scenes that one run alone solves make the first p-value below 0.05.

    Args:
        n: number of scenes.
        discordant: the share of scenes in which the runs disagree, 0..1. With a difference greater than it, all scenes
            in which they disagree are the better run's.
        alpha: see `mcnemar_power`.
    """

    def missing(difference: float) -> float:
        return _POWER - mcnemar_power(n, difference, max(difference, discordant), alpha=alpha)

    return None if missing(1.0) > 0 else float(root_scalar(missing, bracket=(0.0, 1.0)).root)


def power_warning(comparison: Comparison, *, alpha: float = 0.05) -> str | None:
    """Return a warning if the runs are not told apart at ``alpha``, with the difference that as many scenes would show.

    That difference assumes that the runs disagree in as many scenes as they did, so it is an estimate itself.
    """
    c = comparison
    if c.p_value <= alpha:
        return None
    shown = smallest_paired_difference(c.n, (c.only_a + c.only_b) / c.n, alpha=alpha)
    difference = (
        "no difference, however large" if shown is None else f"differences of {np.ceil(100 * shown):.0f} points or more"
    )
    count = "1 episode shows" if c.n == 1 else f"{c.n} episodes show"
    return f"not told apart: {count} {difference} ({100 * _POWER:g} % power)"
