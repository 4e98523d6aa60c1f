from __future__ import annotations

from math import factorial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.power import (
    mcnemar_power,
    smallest_paired_difference,
    too_few,
)
from robocas_ms3.evaluation.statistics import compare_counts, mcnemar

SHARES = st.just(0.0) | st.floats(1e-9, 1)  # SciPy's binomial overflows at probabilities of 1e-308


@pytest.mark.parametrize(("difference", "discordant"), [(0, 0.4), (0.3, 0.4), (0.4, 0.4), (0.6, 1)])
def test_power_is_the_sum_over_all_outcomes(difference, discordant):
    n, p, q = 14, (discordant + difference) / 2, (discordant - difference) / 2
    told = 0.0
    for a in range(n + 1):
        for b in range(n + 1 - a):
            ways = factorial(n) // (factorial(a) * factorial(b) * factorial(n - a - b))
            if mcnemar(a, b) <= 0.05:
                told += ways * p**a * q**b * (1 - p - q) ** (n - a - b)
    assert mcnemar_power(n, difference, discordant) == pytest.approx(told, abs=1e-12)


@given(st.integers(1, 60), SHARES, st.floats(0.001, 0.2))
def test_equal_runs_are_told_apart_no_more_often_than_alpha(n, discordant, alpha):
    assert mcnemar_power(n, 0.0, discordant, alpha=alpha) <= alpha + 1e-12


def test_six_scenes_are_the_fewest():
    assert smallest_paired_difference(5, 0) is None
    assert smallest_paired_difference(6, 0) == pytest.approx(0.8 ** (1 / 6))  # all six are A's


@given(st.integers(6, 120), SHARES)
def test_the_smallest_difference_has_the_power_asked_for(n, discordant):
    found = smallest_paired_difference(n, discordant)
    assert found is not None
    assert mcnemar_power(n, found, max(found, discordant)) == pytest.approx(0.8, abs=1e-6)


def test_a_warning_says_what_would_show():
    assert too_few(compare_counts(20, 8, 5, 7)) == (
        "not told apart: 40 episodes show differences of 26 points or more (80 % power)"
    )
    assert "5 episodes show no difference, however large" in (too_few(compare_counts(0, 5, 0, 0)) or "")
    assert too_few(compare_counts(0, 6, 0, 0)) is None  # p = 1/32
    assert too_few(compare_counts(0, 6, 0, 0), alpha=0.05 / 2) is not None  # one of two comparisons


@pytest.mark.parametrize("n", [6, 11, 20, 35])
def test_differences_that_show_are_greater_than_those_warned_of(n):
    for m in range(n + 1):
        shown = smallest_paired_difference(n, m / n)
        for b in range(m // 2 + 1):
            comparison = compare_counts(n - m, m - b, b, 0)
            assert too_few(comparison) is None or comparison.difference < shown


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: smallest_paired_difference(0, 0.2), "1 or more"),
        (lambda: smallest_paired_difference(9, -0.2), "discordant: "),
        (lambda: smallest_paired_difference(9, 0.2, power=80), "alpha < power < 1"),
        (lambda: smallest_paired_difference(9, 0.2, power=0.01), "alpha < power < 1"),
        (lambda: mcnemar_power(9, 0.3, 0.2), "difference <= discordant"),
    ],
)
def test_what_is_no_plan_is_an_error(call, words):
    with pytest.raises(EvaluationError) as error:
        call()
    assert words in str(error.value)
