from __future__ import annotations

from math import factorial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, multinomial, norm

from robocas_ms3.evaluation.statistics import (
    Comparison,
    adjust_p_values,
    bin_success_rates,
    compare_successes,
    compute_paired_interval,
    compute_success_rate,
    compute_unpaired_interval,
    find_smallest_difference,
    make_power_warning,
    mcnemar_p_value,
    mcnemar_power,
)

Z2 = norm.isf(0.025) ** 2
FRACTIONS = st.just(0.0) | st.floats(1e-9, 1)  # SciPy's binomial overflows at probabilities of 1e-308
COUNTS = st.tuples(*[st.integers(0, 30)] * 4).filter(any)  # both, only A, only B, neither


@st.composite
def k_of_n(draw) -> tuple[int, int]:
    n = draw(st.integers(1, 500))
    return draw(st.integers(0, n)), n


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [
        (8, 10, 0.4439, 0.9748),
        # Fagerland, Lydersen, Laake: Statistical Analysis of Contingency Tables (2017), tests of its R package
        (13, 16, 0.5435, 0.9595),
        (10, 10, 0.6915, 1),
        (0, 10, 0, 0.3085),
    ],
)
def test_exact_interval_equals_published_values(k, n, low, high):
    found = compute_success_rate(k, n)
    assert (found.k, found.n, found.rate) == (k, n, k / n)
    assert (found.low, found.high) == pytest.approx((low, high), abs=5e-5)


@given(k_of_n())
def test_exact_interval_has_half_of_the_error_at_each_end(counts):
    k, n = counts
    found = compute_success_rate(k, n)
    assert 0 <= found.low <= k / n <= found.high <= 1
    if k > 0:
        assert binom.sf(k - 1, n, found.low) == pytest.approx(0.025, rel=1e-6)
    if k < n:
        assert binom.cdf(k, n, found.high) == pytest.approx(0.025, rel=1e-6)


@pytest.mark.parametrize(
    ("only_a", "only_b", "p_value"),
    [
        (0, 0, 1),
        (3, 3, 1),  # 2 P(X <= 3) is more than 1
        (0, 5, 2 / 2**5),
        (6, 0, 2 / 2**6),
        (1, 7, 2 * (1 + 8) / 2**8),
        (2, 8, 2 * (1 + 10 + 45) / 2**10),
        (6, 16, 0.052479),  # complete responses before and after therapy, Fagerland et al. (2017), ch. 8
    ],
)
def test_mcnemar_equals_published_values(only_a, only_b, p_value):
    assert mcnemar_p_value(only_a, only_b) == pytest.approx(p_value, abs=5e-7)
    assert mcnemar_p_value(only_b, only_a) == mcnemar_p_value(only_a, only_b)


def test_unpaired_interval_equals_published_values():
    """Examples a, c and e of Newcombe (1998), table II, method 10."""
    for a, b, limits in [
        ((56, 70), (48, 80), (0.0524, 0.3339)),
        ((6, 7), (2, 7), (0.0582, 0.8062)),
        ((5, 56), (0, 29), (-0.0381, 0.1926)),
    ]:
        low, high = compute_unpaired_interval(a, b)
        assert (round(low, 4), round(high, 4)) == limits
        assert compute_unpaired_interval(b, a) == pytest.approx((-high, -low))


def test_paired_interval_equals_published_values():
    # Fagerland et al. (2017), ch. 8: its limits by Tango's method
    assert compute_paired_interval(6, 16, 161) == pytest.approx((-0.1240, -0.0054), abs=5e-5)


@pytest.mark.parametrize("n", [1, 7, 40])
def test_paired_interval_of_runs_that_always_or_never_agree_has_a_closed_form(n):
    assert compute_paired_interval(0, 0, n) == pytest.approx((-Z2 / (n + Z2), Z2 / (n + Z2)), abs=1e-9)
    assert compute_paired_interval(n, 0, n) == pytest.approx(((n - Z2) / (n + Z2), 1), abs=1e-9)
    assert compute_paired_interval(0, n, n) == pytest.approx((-1, -(n - Z2) / (n + Z2)), abs=1e-9)


@pytest.mark.parametrize(("n", "worst"), [(7, 0.835), (22, 0.89)])
def test_coverage_of_the_paired_interval(n, worst):
    tables = np.array([(a, b, n - a - b) for a in range(n + 1) for b in range(n + 1 - a)])
    low, high = np.array([compute_paired_interval(a, b, n) for a, b, _ in tables.tolist()]).T
    coverage = []
    for discordant in np.linspace(0.02, 1, 50):
        for difference in discordant * np.linspace(0, 1, 21):
            chances = [(discordant + difference) / 2, (discordant - difference) / 2, 1 - discordant]
            covered = (low - 1e-9 <= difference) & (difference <= high + 1e-9)
            coverage.append(multinomial.pmf(tables, n, chances) @ covered)
    assert min(coverage) > worst
    assert np.percentile(coverage, 5) > 0.94
    assert np.mean(coverage) > 0.95


@given(COUNTS)
def test_swapping_the_runs_swaps_the_signs(counts):
    both, only_a, only_b, neither = counts
    ours, swapped = (
        Comparison.from_counts(both, only_a, only_b, neither),
        Comparison.from_counts(both, only_b, only_a, neither),
    )
    assert ours.p_value == swapped.p_value
    assert ours.difference == -swapped.difference
    assert (ours.low, ours.high) == pytest.approx((-swapped.high, -swapped.low), abs=1e-9)
    assert -1 <= ours.low <= ours.difference <= ours.high <= 1
    assert ours.low < ours.high


def test_runs_are_compared_per_scene():
    a = np.array([1, 1, 1, 1, 1, 0, 0, 0], dtype=bool)
    b = np.array([1, 1, 0, 0, 0, 1, 0, 0], dtype=bool)
    found = compare_successes(a, b)
    assert (found.both, found.only_a, found.only_b, found.neither) == (2, 3, 1, 2)
    assert (found.successes_a, found.successes_b, found.n, found.difference) == (5, 3, 8, 0.25)
    assert found == Comparison.from_counts(2, 3, 1, 2)
    assert found.p_value == pytest.approx(2 * (1 + 4) / 2**4)
    assert compare_successes(a.tolist(), a.tolist()).p_value == 1


def test_holm_equals_values_computed_by_hand():
    assert adjust_p_values([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert adjust_p_values([0.7, 0.6]) == [1, 1]
    assert adjust_p_values([0.2]) == [0.2]
    assert adjust_p_values([]) == []


def test_bins_contain_their_lower_edge_and_the_last_bin_both_edges():
    values = [0.0, 0.2, 0.5, 0.5, 0.9, 1.0]
    successes = [False, True, True, False, True, True]
    found = bin_success_rates(values, successes, [0, 0.5, 0.75, 0.8, 1])
    assert found == [compute_success_rate(1, 2), compute_success_rate(1, 2), None, compute_success_rate(2, 2)]


@pytest.mark.parametrize(("difference", "discordant"), [(0, 0.4), (0.3, 0.4), (0.4, 0.4), (0.6, 1)])
def test_power_equals_the_sum_over_all_outcomes(difference, discordant):
    n, p, q = 14, (discordant + difference) / 2, (discordant - difference) / 2
    power = 0.0
    for a in range(n + 1):
        for b in range(n + 1 - a):
            ways = factorial(n) // (factorial(a) * factorial(b) * factorial(n - a - b))
            if mcnemar_p_value(a, b) <= 0.05:
                power += ways * p**a * q**b * (1 - p - q) ** (n - a - b)
    assert mcnemar_power(n, difference, discordant) == pytest.approx(power, abs=1e-12)


def test_fewer_than_six_scenes_show_no_difference():
    assert find_smallest_difference(5, 0) is None
    assert find_smallest_difference(6, 0) == pytest.approx(0.8 ** (1 / 6))  # A solves all six


@given(st.integers(6, 120), FRACTIONS)
def test_smallest_difference_has_80_percent_power(n, discordant):
    found = find_smallest_difference(n, discordant)
    assert found is not None
    assert mcnemar_power(n, found, max(found, discordant)) == pytest.approx(0.8, abs=1e-6)


def test_warning_names_the_detectable_difference():
    assert make_power_warning(Comparison.from_counts(20, 8, 5, 7)) == (
        "no significant difference: 40 episodes are enough to detect 26 percentage points or more with 80 % power"
    )
    assert "5 episodes are too few" in (make_power_warning(Comparison.from_counts(0, 5, 0, 0)) or "")
    assert make_power_warning(Comparison.from_counts(0, 6, 0, 0)) is None  # p = 1/32
    assert make_power_warning(Comparison.from_counts(0, 6, 0, 0), alpha=0.05 / 2) is not None  # one of two comparisons


def test_statistics_equal_those_of_robostats():
    """Runs in scripts/check_others.sh, which installs robostats."""
    robostats = pytest.importorskip("robostats")
    for n in (1, 2, 10, 39, 200):
        for k in {0, 1, n // 3, n - 1, n}:
            theirs = robostats.clopper_pearson(k, n)
            assert (compute_success_rate(k, n).low, compute_success_rate(k, n).high) == pytest.approx(
                (theirs.lower, theirs.upper), abs=1e-12
            )
    for counts in [(20, 8, 5, 7), (59, 6, 16, 80), (0, 12, 0, 0), (9, 0, 0, 4), (3, 0, 6, 1), (0, 4, 4, 0)]:
        table = robostats.PairedResult("a", "b", *counts, tuple(map(str, range(sum(counts)))), 0, 0, ("",), ("",), None)
        theirs, ours = robostats.compare(table), Comparison.from_counts(*counts)
        assert ours.p_value == pytest.approx(theirs.p_value, abs=1e-12)
        assert (ours.low, ours.high) == pytest.approx((theirs.interval.lower, theirs.interval.upper), abs=1e-10)
    kmodel = pytest.importorskip("robostats.kmodel")
    for p_values in ([0.01, 0.04, 0.03, 0.005], [0.2, 0.2, 0.9], [0.001]):
        assert adjust_p_values(p_values) == pytest.approx(kmodel.adjust(p_values, "holm"), abs=1e-15)
