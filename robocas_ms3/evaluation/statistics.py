"""Statistics of success counts: rates with intervals, paired comparisons, and their power."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import root_scalar
from scipy.stats import beta, binom, binomtest, norm

_TAIL = (1 - 0.95) / 2  # error probability at each end of an interval
_POWER = 0.8


@dataclass(frozen=True)
class SuccessRate:
    """Success rate: k successes of n episodes, with the limits ``low`` and ``high`` of its 95 % interval, 0..1."""

    k: int
    n: int
    low: float
    high: float

    @property
    def rate(self) -> float:
        """Return the success rate k / n."""
        return self.k / self.n


@dataclass(frozen=True)
class Comparison:
    """Paired comparison of the successes of two runs, A and B, in the same scenes.

    Attributes:
        both, only_a, only_b, neither: numbers of scenes in which both runs, only A, only B or neither succeeded.
        p_value: two-sided p-value of the hypothesis that A and B have equal success rates (`mcnemar_p_value`).
        low, high: 95 % interval of the difference of the rates, A - B, -1..1 (`compute_paired_interval`).
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
        """Return the comparison for these numbers of scenes (fields of `Comparison`), with p-value and interval."""
        limits = compute_paired_interval(only_a, only_b, both + only_a + only_b + neither)
        return cls(both, only_a, only_b, neither, mcnemar_p_value(only_a, only_b), *limits)

    @property
    def n(self) -> int:
        """Return the number of scenes."""
        return self.both + self.only_a + self.only_b + self.neither

    @property
    def successes_a(self) -> int:
        """Return the number of scenes in which A succeeded."""
        return self.both + self.only_a

    @property
    def successes_b(self) -> int:
        """Return the number of scenes in which B succeeded."""
        return self.both + self.only_b

    @property
    def difference(self) -> float:
        """Return the difference of the success rates, A - B, -1..1."""
        return (self.only_a - self.only_b) / self.n


def compute_success_rate(k: int, n: int) -> SuccessRate:
    """Return a success rate with its exact 95 % interval.

    Clopper and Pearson, Biometrika 26 (1934) 404-413, by quantiles of beta distributions. The interval contains the
    true rate in at least 95 % of all evaluations. At k = 0 the lower limit is 0, at k = n the upper limit is 1; the
    other limit has an error probability of 2.5 %.
    """
    low = float(beta.ppf(_TAIL, k, n - k + 1)) if k else 0.0
    high = float(beta.isf(_TAIL, k + 1, n - k)) if k < n else 1.0
    return SuccessRate(k, n, low, high)


def compute_unpaired_interval(a: tuple[int, int], b: tuple[int, int]) -> tuple[float, float]:
    """Return Newcombe's 95 % interval of the difference of two independent rates, A - B.

    Method 10 of Newcombe, Statistics in Medicine 17 (1998) 873-890, which combines Wilson's intervals of both rates.
    For runs over the same scenes, `compute_paired_interval` is usually narrower.

    Args:
        a, b: (k, n): k successes of n episodes.
    """
    (low_a, high_a), (low_b, high_b) = (binomtest(*one).proportion_ci(1 - 2 * _TAIL, "wilson") for one in (a, b))
    rate_a, rate_b = a[0] / a[1], b[0] / b[1]
    below, above = np.hypot(rate_a - low_a, high_b - rate_b), np.hypot(high_a - rate_a, rate_b - low_b)
    return float(rate_a - rate_b - below), float(rate_a - rate_b + above)


def mcnemar_p_value(only_a: int, only_b: int) -> float:
    """Return McNemar's exact two-sided p-value of two runs over the same scenes.

    McNemar, Psychometrika 12 (1947) 153-157, exact form: with equal rates, a scene that only one run solves is solved
    by A with probability 1/2. The p-value is twice the binomial tail of the smaller count, at most 1.
    """
    return min(1.0, 2 * float(binom.cdf(min(only_a, only_b), only_a + only_b, 0.5)))


def compute_paired_interval(only_a: int, only_b: int, n: int) -> tuple[float, float]:
    """Return Tango's 95 % score interval of the difference of two rates over the same n scenes, A - B.

    The interval contains the differences d that the score test of paired data does not reject (Tango, Statistics in
    Medicine 17 (1998) 891-908):

        |only_a - only_b - n d| <= z sqrt(n (2 q + d (1 - d)))

    where q is the most likely probability of a scene that only B solves, given d. The interval is within -1..1 and has
    a positive width even if the runs agree in all scenes. Its coverage with 6 to 50 scenes is at least 95 % on average
    over the true rates, at least 94 % for 19 of 20 true rates, and at worst 89 % from 9 scenes on (83 % below 9). The
    worst cases are runs that disagree in nearly all scenes. The score test is approximate: if the exact p-value is
    slightly above 0.05, the interval can exclude 0. Decide by the p-value.
    """
    z2 = float(norm.isf(_TAIL)) ** 2
    middle = (only_a - only_b) / n

    def score_excess(d: float) -> float:
        if d == middle:
            return -1.0  # with zero variance the value is 0 here, which is no limit of the interval
        # q solves 2 n q^2 + linear q - only_b d (1 - d) = 0
        linear = (2 * n - only_a + only_b) * d - only_a - only_b
        q = (np.sqrt(max(0.0, linear**2 + 8 * n * only_b * d * (1 - d))) - linear) / (4 * n)
        return (only_a - only_b - n * d) ** 2 - z2 * n * (2 * q + d * (1 - d))

    low, high = (
        float(root_scalar(score_excess, bracket=(middle, end), xtol=1e-14).root) if middle != end else end
        for end in (-1.0, 1.0)
    )
    return low, high


def compare_successes(a: ArrayLike, b: ArrayLike) -> Comparison:
    """Compare two runs by their successes, each (n,) bool with the scenes in the same order."""
    a, b = np.asarray(a, dtype=bool), np.asarray(b, dtype=bool)
    return Comparison.from_counts(*(int(cases.sum()) for cases in (a & b, a & ~b, ~a & b, ~a & ~b)))


def adjust_p_values(p_values: Sequence[float]) -> list[float]:
    """Return the p-values of several comparisons, adjusted by Holm's method and in the given order.

    If a difference is claimed where the adjusted p-value is at most alpha, the probability of any false claim is at
    most alpha. The i-th smallest of m p-values is multiplied by m - i + 1, and is at least the previous adjusted value
    (Holm, Scandinavian Journal of Statistics 6 (1979) 65-70).
    """
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)))
    return adjusted.tolist()


def bin_success_rates(values: ArrayLike, successes: ArrayLike, edges: Sequence[float]) -> list[SuccessRate | None]:
    """Return the success rate of each bin of a value per episode, such as p_vis; None for an empty bin.

    Args:
        values: (n,) values between the first and the last edge.
        successes: (n,) bool, whether the episode succeeded.
        edges: (bins + 1,) ascending edges; a bin contains its lower edge, the last bin also its upper edge.
    """
    done, ends = np.asarray(successes, dtype=bool), np.asarray(edges, dtype=float)
    place = np.minimum(np.searchsorted(ends, np.asarray(values), side="right") - 1, len(ends) - 2)
    groups = [done[place == number] for number in range(len(ends) - 1)]
    return [compute_success_rate(int(group.sum()), group.size) if group.size else None for group in groups]


def mcnemar_power(n: int, difference: float, discordant: float, *, alpha: float = 0.05) -> float:
    """Return the probability that the exact McNemar test detects a difference of two runs over the same n scenes.

    The probability is summed exactly over the number of scenes in which the runs disagree.

    Args:
        n: number of scenes.
        difference: difference of the true rates, 0..1.
        discordant: probability that exactly one run succeeds in a scene, at least ``difference``.
        alpha: significance level of the p-value.
    """
    m = np.arange(1, n + 1)  # number of scenes in which the runs disagree
    # Largest count of the weaker run with a significant p-value; -1: no count.
    most = binom.ppf(alpha / 2, m, 0.5)
    most = np.where(binom.cdf(most, m, 0.5) <= alpha / 2, most, most - 1)
    better = (1 + difference / discordant) / 2 if discordant else 0.5
    detected = binom.cdf(most, m, 1 - better) + binom.cdf(most, m, better)
    return float(binom.pmf(m, n, discordant) @ detected)


def find_smallest_difference(n: int, discordant: float, *, alpha: float = 0.05) -> float | None:
    """Return the smallest difference of two success rates that a comparison over n scenes detects with 80 % power.

    Returns None if n is too small for any difference: a p-value below 0.05 needs at least six scenes that only one run
    solves.

    Args:
        n: number of scenes.
        discordant: fraction of scenes in which exactly one run succeeds, 0..1. For a greater difference, the better
            run is assumed to solve all scenes in which the runs disagree.
        alpha: significance level of the p-value.
    """

    def missing_power(difference: float) -> float:
        return _POWER - mcnemar_power(n, difference, max(difference, discordant), alpha=alpha)

    return None if missing_power(1.0) > 0 else float(root_scalar(missing_power, bracket=(0.0, 1.0)).root)


def make_power_warning(comparison: Comparison, *, alpha: float = 0.05) -> str | None:
    """Return a warning if the p-value of a comparison is above ``alpha``; None otherwise.

    The warning names the smallest difference that this number of scenes detects with 80 % power. This is an estimate,
    because it assumes the observed fraction of scenes in which the runs disagree.
    """
    c = comparison
    if c.p_value <= alpha:
        return None
    shown = find_smallest_difference(c.n, (c.only_a + c.only_b) / c.n, alpha=alpha)
    count = "1 episode is" if c.n == 1 else f"{c.n} episodes are"
    if shown is None:
        return f"no significant difference: {count} too few to detect any difference with {100 * _POWER:g} % power"
    least = f"{np.ceil(100 * shown):.0f} percentage points"
    return f"no significant difference: {count} enough to detect {least} or more with {100 * _POWER:g} % power"
