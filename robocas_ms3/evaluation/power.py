"""What a number of episodes can tell: the smallest difference of two rates that it shows, and a warning below it."""

from __future__ import annotations

import numpy as np
from scipy.optimize import root_scalar
from scipy.stats import binom

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.statistics import Comparison


def mcnemar_power(n: int, difference: float, discordant: float, *, alpha: float = 0.05) -> float:
    """The probability that the exact McNemar test tells two runs over the same n scenes apart.

    Summed exactly over the number of scenes in which the runs disagree, and over whose they are.

    Args:
        n: scenes.
        difference: of the true rates, 0..1.
        discordant: the probability that the runs disagree in a scene, ``difference`` at least.
        alpha: they are told apart where the p-value is this or less.
    """
    if not 0 <= difference <= discordant <= 1:
        raise EvaluationError(
            "no such runs",
            where="difference",
            expected="0 <= difference <= discordant <= 1",
            found=(difference, discordant),
        )
    m = np.arange(1, n + 1)  # scenes in which they disagree
    # The largest count of the weaker run that is told apart; -1 where none is.
    most = binom.ppf(alpha / 2, m, 0.5)
    most = np.where(binom.cdf(most, m, 0.5) <= alpha / 2, most, most - 1)
    better = (1 + difference / discordant) / 2 if discordant else 0.5
    told = binom.cdf(most, m, 1 - better) + binom.cdf(most, m, better)
    return float(binom.pmf(m, n, discordant) @ told)


def smallest_paired_difference(n: int, discordant: float, *, power: float = 0.8, alpha: float = 0.05) -> float | None:
    """The smallest difference of rates that two runs over the same n scenes show with probability ``power``.

    None where n is too small for any: six scenes that one run alone solves make the first p-value below 0.05.

    Args:
        n: scenes.
        discordant: the share of scenes in which the runs disagree, 0..1. Of a difference greater than it, all scenes in
            which they disagree are the better run's; with 0 that holds for every difference, the best of cases but for
            a handful of scenes.
        power: probability, 0..1.
        alpha: see `mcnemar_power`.
    """

    def missing(difference: float) -> float:
        return power - mcnemar_power(n, difference, max(difference, discordant), alpha=alpha)

    if n < 1:
        raise EvaluationError("no episodes", where="n", expected="1 or more", found=n)
    if not 0 <= discordant <= 1:
        raise EvaluationError("no share of episodes", where="discordant", expected="0..1", found=discordant)
    if not 0 < alpha < power < 1:
        raise EvaluationError("no power", where="power", expected="0 < alpha < power < 1", found=f"{alpha=}, {power=}")
    return None if missing(1.0) > 0 else float(root_scalar(missing, bracket=(0.0, 1.0)).root)


def too_few(comparison: Comparison, *, alpha: float = 0.05, power: float = 0.8) -> str | None:
    """A sentence of warning where the runs are not told apart, with the difference that so many scenes would show.

    That difference takes the runs to disagree in as many scenes as they did, so it is an estimate itself.

    Args:
        comparison: the two runs.
        alpha: they are told apart where the p-value is this or less; of m comparisons, each may have alpha / m.
        power: see `smallest_paired_difference`.
    """
    c = comparison
    if c.p_value <= alpha:
        return None
    shown = smallest_paired_difference(c.n, (c.only_a + c.only_b) / c.n, power=power, alpha=alpha)
    what_shows = (
        "no difference, however large" if shown is None else f"differences of {np.ceil(100 * shown):.0f} points or more"
    )
    count = "1 episode shows" if c.n == 1 else f"{c.n} episodes show"
    return f"not told apart: {count} {what_shows} ({100 * power:g} % power)"
