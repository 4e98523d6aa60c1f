"""What counts of successes say: intervals of rates, two runs over the same scenes, several comparisons, bins."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import root_scalar
from scipy.stats import beta, binom, norm

from robocas_ms3.core.errors import EvaluationError


@dataclass(frozen=True)
class Share:
    """A rate of successes and the interval it lies in.

    Attributes:
        k: episodes that succeeded.
        n: episodes, 1 at least.
        low: lower end of the interval of the rate, 0..1.
        high: upper end.
        level: confidence of the interval, 0..1.
    """

    k: int
    n: int
    low: float
    high: float
    level: float = 0.95

    def __post_init__(self) -> None:
        _check_counts(k=self.k, n=self.n)
        if not self.k <= self.n or self.n == 0:
            raise EvaluationError("no share", where="k of n", expected="0 <= k <= n, n > 0", found=(self.k, self.n))
        _check_level(self.level)
        _check_order("interval of a share", 0.0, self.low, self.rate, self.high, 1.0)

    @property
    def rate(self) -> float:
        """Successes per episode."""
        return self.k / self.n


@dataclass(frozen=True)
class Comparison:
    """Two runs, A and B, over the same scenes.

    Attributes:
        both: scenes in which A and B succeeded.
        only_a: scenes in which only A did.
        only_b: scenes in which only B did.
        neither: scenes in which both failed.
        p_value: two-sided, of the hypothesis that A and B succeed equally often.
        low: lower end of the interval of A's rate less B's, -1..1.
        high: upper end.
        level: confidence of the interval, 0..1.
    """

    both: int
    only_a: int
    only_b: int
    neither: int
    p_value: float
    low: float
    high: float
    level: float = 0.95

    def __post_init__(self) -> None:
        _check_counts(both=self.both, only_a=self.only_a, only_b=self.only_b, neither=self.neither)
        if self.n == 0:
            raise EvaluationError("there are no scenes to compare runs over", where="comparison")
        _check_level(self.level)
        _check_order("p-value", 0.0, self.p_value, 1.0)
        _check_order("interval of a difference", -1.0, self.low, self.difference, self.high, 1.0)

    @property
    def n(self) -> int:
        """How many scenes both runs saw."""
        return self.both + self.only_a + self.only_b + self.neither

    @property
    def successes_a(self) -> int:
        """In how many of them A succeeded."""
        return self.both + self.only_a

    @property
    def successes_b(self) -> int:
        """In how many of them B succeeded."""
        return self.both + self.only_b

    @property
    def difference(self) -> float:
        """A's rate less B's, -1..1."""
        return (self.only_a - self.only_b) / self.n


@dataclass(frozen=True)
class Bin:
    """The successes among episodes whose value lies in [low, high); ``share`` is None where there are none."""

    low: float
    high: float
    share: Share | None


def share(k: int, n: int, level: float = 0.95) -> Share:
    """The exact interval of a rate: it holds the true one in a share of at least ``level`` of all evaluations.

    Clopper and Pearson, Biometrika 26 (1934) 404-413, by quantiles of beta distributions. At k = 0 the lower end is 0
    and at k = n the upper end is 1; the other end keeps its half of the error, so that it is as far as for other k.
    """
    k, n = _check_counts(k=k, n=n)
    _check_level(level)
    tail = (1 - level) / 2
    low = float(beta.ppf(tail, k, n - k + 1)) if 0 < k <= n else 0.0
    high = float(beta.isf(tail, k + 1, n - k)) if k < n else 1.0
    return Share(k, n, low, high, level)


def mcnemar(only_a: int, only_b: int) -> float:
    """The exact two-sided p-value of two runs over the same scenes; 1 where they disagree in no scene.

    Under the hypothesis of equal rates, a scene that one run alone solves is either's with probability 1/2, so the
    p-value is twice the binomial tail of the smaller count, 1 at most (McNemar, Psychometrika 12 (1947) 153-157, exact
    form). Where there is no such scene, nothing speaks against the hypothesis.
    """
    only_a, only_b = _check_counts(only_a=only_a, only_b=only_b)
    return min(1.0, 2 * float(binom.cdf(min(only_a, only_b), only_a + only_b, 0.5)))


def paired_interval(only_a: int, only_b: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Tango's score interval of the difference of two rates over the same n scenes, A's less B's.

    The differences d that the score test of paired data does not reject (Tango, Statistics in Medicine 17 (1998)
    891-908):

        |only_a - only_b - n d| <= z sqrt(n (2 q + d (1 - d)))

    where q is the likeliest probability of a scene that B alone solves, given d. It stays within -1..1 and has a
    width where the runs disagree in no scene. Of 6 to 50 scenes at 95 % it holds the true difference in 95 % of cases
    or more on average over the truths, in 94 % or more for nineteen truths of twenty, and in 89 % at worst from 9
    scenes on (83 % below); the worst are runs that disagree nearly everywhere. The test in it is approximate: where the
    exact p-value is a little above 1 - level, the interval can leave 0 out. Claims go by the p-value.
    """
    only_a, only_b, n = _check_counts(only_a=only_a, only_b=only_b, n=n)
    if only_a + only_b > n or n == 0:
        raise EvaluationError("no paired counts", where="n", expected=f"{max(1, only_a + only_b)} or more", found=n)
    _check_level(level)
    z2 = float(norm.isf((1 - level) / 2)) ** 2
    middle = (only_a - only_b) / n

    def excess(d: float) -> float:
        """Negative inside the interval."""
        if d == middle:
            return -1.0  # it is 0 there where the variance is, which is no end of the interval
        # q solves 2 n q^2 + linear q - only_b d (1 - d) = 0
        linear = (2 * n - only_a + only_b) * d - only_a - only_b
        q = (np.sqrt(max(0.0, linear**2 + 8 * n * only_b * d * (1 - d))) - linear) / (4 * n)
        return (only_a - only_b - n * d) ** 2 - z2 * n * (2 * q + d * (1 - d))

    low, high = (
        float(root_scalar(excess, bracket=(middle, end), xtol=1e-14).root) if middle != end else end
        for end in (-1.0, 1.0)
    )
    return low, high


def compare(a: ArrayLike, b: ArrayLike, level: float = 0.95) -> Comparison:
    """Two runs over the same scenes.

    Args:
        a: (n,) bool, whether run A succeeded in each scene.
        b: (n,) bool, the same of run B, scenes in the same order.
        level: confidence of the interval of the difference.
    """
    a, b = _successes(a, "a"), _successes(b, "b")
    if a.shape != b.shape:
        raise EvaluationError("runs over different scenes", where="b", expected=f"{a.size} scenes", found=b.size)
    return compare_counts(
        int((a & b).sum()), int((a & ~b).sum()), int((~a & b).sum()), int((~a & ~b).sum()), level=level
    )


def compare_counts(both: int, only_a: int, only_b: int, neither: int, level: float = 0.95) -> Comparison:
    """Two runs of which the counts of scenes are known: see `Comparison`, `mcnemar` and `paired_interval`."""
    both, only_a, only_b, neither = _check_counts(both=both, only_a=only_a, only_b=only_b, neither=neither)
    low, high = paired_interval(only_a, only_b, both + only_a + only_b + neither, level)
    return Comparison(both, only_a, only_b, neither, mcnemar(only_a, only_b), low, high, level)


def holm(p_values: Sequence[float]) -> list[float]:
    """The p-values of several comparisons, adjusted, in their order.

    Whoever claims a difference where they are alpha or less makes any false claim with probability alpha at most. The
    i-th smallest of m is multiplied by m - i + 1, and is no less than those before it (Holm, Scandinavian Journal of
    Statistics 6 (1979) 65-70).
    """
    p = np.asarray(p_values, dtype=float)
    if p.ndim != 1 or not ((p >= 0) & (p <= 1)).all():
        raise EvaluationError("no p-values", where="p_values", expected="a list of numbers in 0..1", found=p_values)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)))
    return adjusted.tolist()


def success_by(values: ArrayLike, successes: ArrayLike, edges: Sequence[float], level: float = 0.95) -> list[Bin]:
    """Rates of success over bins of a number that each episode has, for example p_vis.

    Args:
        values: (n,) the number, within the outermost edges.
        successes: (n,) bool.
        edges: (bins + 1,) ascending; a bin holds its lower edge, the last one its upper edge too.
        level: confidence of each bin's interval.
    """
    x, done, ends = np.asarray(values, dtype=float), _successes(successes, "successes"), np.asarray(edges, dtype=float)
    if x.shape != done.shape:
        raise EvaluationError("values of other episodes", where="values", expected=done.shape, found=x.shape)
    if ends.ndim != 1 or len(ends) < 2 or not (np.diff(ends) > 0).all():
        raise EvaluationError("no bins", where="edges", expected="two or more ascending numbers", found=edges)
    outside = x[~((x >= ends[0]) & (x <= ends[-1]))]  # NaN too
    if outside.size:
        raise EvaluationError(
            "values outside all bins", where="values", expected=f"{ends[0]:g}..{ends[-1]:g}", found=outside[:3].tolist()
        )
    place = np.minimum(np.searchsorted(ends, x, side="right") - 1, len(ends) - 2)
    bins = []
    for i, (low, high) in enumerate(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)):
        inside = done[place == i]
        bins.append(Bin(low, high, share(int(inside.sum()), inside.size, level) if inside.size else None))
    return bins


def _check_counts(**counts: int) -> tuple[int, ...]:
    """The counts as Python's integers."""
    found = []
    for name, value in counts.items():
        try:
            found.append(operator.index(value))
        except TypeError as error:
            raise EvaluationError("no count", where=name, expected="an integer", found=value) from error
        if found[-1] < 0:
            raise EvaluationError("no count", where=name, expected="0 or more", found=value)
    return tuple(found)


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        raise EvaluationError("no level of confidence", where="level", expected="0 < level < 1", found=level)


def _check_order(what: str, *numbers: float) -> None:
    if not all(a <= b for a, b in zip(numbers, numbers[1:], strict=False)):
        raise EvaluationError("numbers out of order", where=what, expected="ascending", found=numbers)


def _successes(values: ArrayLike, where: str) -> NDArray[np.bool_]:
    """Successes as an array (n,), of bools only."""
    array = np.asarray(values)
    if array.dtype != bool or array.ndim != 1:
        raise EvaluationError("no successes", where=where, expected="(n,) bool", found=f"{array.shape} {array.dtype}")
    return array
