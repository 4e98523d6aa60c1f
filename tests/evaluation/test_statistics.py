from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, multinomial, norm

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.statistics import (
    Comparison,
    Share,
    compare,
    compare_counts,
    holm,
    mcnemar,
    paired_interval,
    share,
    success_by,
)

Z2 = norm.isf(0.025) ** 2
LEVELS = st.floats(0.5, 0.999)
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
def test_exact_interval_is_the_published_one(k, n, low, high):
    found = share(k, n)
    assert (found.k, found.n, found.rate) == (k, n, k / n)
    assert (found.low, found.high) == pytest.approx((low, high), abs=5e-5)


def test_exact_interval_at_the_edges_has_a_formula():
    # all of n fail with probability (1 - p)^n
    assert (share(0, 20).low, share(0, 20).high) == pytest.approx((0, 1 - 0.025 ** (1 / 20)), abs=1e-12)
    assert (share(20, 20).low, share(20, 20).high) == pytest.approx((0.025 ** (1 / 20), 1), abs=1e-12)
    assert (share(1, 1, 0.9).low, share(1, 1, 0.9).high) == pytest.approx((0.05, 1), abs=1e-12)


@given(k_of_n(), LEVELS)
def test_exact_interval_ends_where_half_the_error_is_left(counts, level):
    k, n = counts
    found = share(k, n, level)
    assert 0 <= found.low <= k / n <= found.high <= 1
    if k > 0:
        assert binom.sf(k - 1, n, found.low) == pytest.approx((1 - level) / 2, rel=1e-6)
    if k < n:
        assert binom.cdf(k, n, found.high) == pytest.approx((1 - level) / 2, rel=1e-6)


@given(k_of_n(), LEVELS)
def test_exact_interval_mirrors_grows_with_k_and_nests(counts, level):
    k, n = counts
    found, mirrored, wider = share(k, n, level), share(n - k, n, level), share(k, n, (1 + level) / 2)
    assert (1 - mirrored.high, 1 - mirrored.low) == pytest.approx((found.low, found.high), abs=1e-9)
    assert wider.low <= found.low <= found.high <= wider.high
    if k < n:
        above = share(k + 1, n, level)
        assert above.low > found.low and above.high > found.high


@pytest.mark.parametrize("n", [1, 2, 5, 10, 20, 40, 63, 100])
def test_exact_interval_covers_every_rate_as_often_as_it_says(n):
    found = [share(k, n) for k in range(n + 1)]
    low, high = np.array([x.low for x in found]), np.array([x.high for x in found])
    rates = np.concatenate([np.linspace(0, 1, 1001), low, high])[:, None]
    covered = (low <= rates + 1e-12) & (rates - 1e-12 <= high)
    assert (binom.pmf(np.arange(n + 1), n, rates) * covered).sum(axis=1).min() >= 0.95


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
def test_exact_mcnemar(only_a, only_b, p_value):
    assert mcnemar(only_a, only_b) == pytest.approx(p_value, abs=5e-7)
    assert mcnemar(only_b, only_a) == mcnemar(only_a, only_b)


@given(st.integers(0, 60), st.integers(0, 60))
def test_p_value_falls_as_the_runs_part(a, b):
    low, high = sorted((a, b))
    assert mcnemar(low, high + 1) <= mcnemar(low, high)


def test_paired_interval_is_the_published_one():
    # Fagerland et al. (2017), ch. 8: its limits by Tango's method
    assert paired_interval(6, 16, 161) == pytest.approx((-0.1240, -0.0054), abs=5e-5)


@pytest.mark.parametrize("n", [1, 7, 40])
def test_paired_interval_of_runs_that_agree_or_never_do_has_a_formula(n):
    assert paired_interval(0, 0, n) == pytest.approx((-Z2 / (n + Z2), Z2 / (n + Z2)), abs=1e-9)
    assert paired_interval(n, 0, n) == pytest.approx(((n - Z2) / (n + Z2), 1), abs=1e-9)
    assert paired_interval(0, n, n) == pytest.approx((-1, -(n - Z2) / (n + Z2)), abs=1e-9)


def test_paired_interval_of_runs_that_disagree_everywhere_is_wilsons():
    # A alone solves k of n: the difference is 2 p - 1, and the score interval of p Wilson's
    k, n = 13, 20
    centre = (k + Z2 / 2) / (n + Z2)
    half = np.sqrt(Z2 * (k * (n - k) / n + Z2 / 4)) / (n + Z2)
    assert paired_interval(k, n - k, n) == pytest.approx((2 * (centre - half) - 1, 2 * (centre + half) - 1), abs=1e-9)


@pytest.mark.parametrize(("n", "worst"), [(7, 0.835), (22, 0.89)])
def test_paired_interval_covers_about_as_often_as_it_says(n, worst):
    tables = np.array([(a, b, n - a - b) for a in range(n + 1) for b in range(n + 1 - a)])
    low, high = np.array([paired_interval(a, b, n) for a, b, _ in tables.tolist()]).T
    coverage = []
    for discordant in np.linspace(0.02, 1, 50):
        for difference in discordant * np.linspace(0, 1, 21):
            chances = [(discordant + difference) / 2, (discordant - difference) / 2, 1 - discordant]
            covered = (low - 1e-9 <= difference) & (difference <= high + 1e-9)
            coverage.append(multinomial.pmf(tables, n, chances) @ covered)
    assert min(coverage) > worst
    assert np.percentile(coverage, 5) > 0.94
    assert np.mean(coverage) > 0.95


@given(COUNTS, LEVELS)
def test_swapping_the_runs_swaps_signs(counts, level):
    both, only_a, only_b, neither = counts
    ours = compare_counts(both, only_a, only_b, neither, level)
    swapped = compare_counts(both, only_b, only_a, neither, level)
    assert ours.p_value == swapped.p_value
    assert ours.difference == -swapped.difference
    assert (ours.low, ours.high) == pytest.approx((-swapped.high, -swapped.low), abs=1e-9)
    assert -1 <= ours.low <= ours.difference <= ours.high <= 1
    assert ours.low < ours.high


@given(st.integers(0, 20), st.integers(0, 20), st.integers(1, 20))
def test_paired_interval_follows_the_difference(only_a, only_b, rest):
    n = only_a + only_b + rest
    low, high = paired_interval(only_a, only_b, n)
    above_low, above_high = paired_interval(only_a + 1, only_b, n)
    assert above_low > low and above_high > high


def test_runs_are_compared_scene_by_scene():
    a = np.array([1, 1, 1, 1, 1, 0, 0, 0], dtype=bool)
    b = np.array([1, 1, 0, 0, 0, 1, 0, 0], dtype=bool)
    found = compare(a, b)
    assert (found.both, found.only_a, found.only_b, found.neither) == (2, 3, 1, 2)
    assert (found.successes_a, found.successes_b, found.n, found.difference) == (5, 3, 8, 0.25)
    assert found == compare_counts(2, 3, 1, 2)
    assert found.p_value == pytest.approx(2 * (1 + 4) / 2**4)
    assert compare(a.tolist(), a.tolist()).p_value == 1


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.7, 0.6]) == [1, 1]
    assert holm([0.2]) == [0.2]
    assert holm([]) == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
def test_holm_lies_between_none_and_bonferroni(p_values):
    adjusted = holm(p_values)
    for p, q in zip(p_values, adjusted, strict=True):
        assert p <= q <= min(1, len(p_values) * p)
    assert np.all(np.diff(np.array(adjusted)[np.argsort(p_values, kind="stable")]) >= 0)
    assert min(adjusted) == min(1, len(p_values) * min(p_values))


def test_bins_hold_their_lower_edge_and_the_last_one_both():
    values = [0.0, 0.2, 0.5, 0.5, 0.9, 1.0]
    successes = [False, True, True, False, True, True]
    found = success_by(values, successes, [0, 0.5, 0.75, 0.8, 1])
    assert [(x.low, x.high) for x in found] == [(0, 0.5), (0.5, 0.75), (0.75, 0.8), (0.8, 1)]
    assert [x.share for x in found] == [share(1, 2), share(1, 2), None, share(2, 2)]


@given(st.lists(st.tuples(st.floats(0, 1), st.booleans()), max_size=40))
def test_bins_hold_every_episode_once(episodes):
    values, successes = [x for x, _ in episodes], np.array([done for _, done in episodes], dtype=bool)
    shares = [x.share for x in success_by(values, successes, [0, 0.3, 0.9, 1]) if x.share]
    assert sum(x.n for x in shares) == len(episodes)
    assert sum(x.k for x in shares) == successes.sum()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: share(3, 2), "k of n"),
        (lambda: share(0, 0), "n > 0"),
        (lambda: share(-1, 2), "0 or more"),
        (lambda: share(0.5, 2), "an integer"),  # type: ignore[arg-type]
        (lambda: share(1, 2, 95), "0 < level < 1"),
        (lambda: Share(1, 2, 0.6, 0.9), "out of order"),
        (lambda: Comparison(1, 1, 0, 0, 1.5, 0, 1), "p-value"),
        (lambda: compare_counts(0, 0, 0, 0), "n: "),
        (lambda: paired_interval(3, 3, 5), "6 or more"),
        (lambda: compare([True], [True, False]), "1 scenes, found 2"),
        (lambda: compare([1, 0], [True, False]), "(n,) bool"),
        (lambda: holm([0.5, 1.5]), "0..1"),
        (lambda: holm([float("nan")]), "0..1"),
        (lambda: success_by([0.1, 1.2], [True, False], [0, 1]), "found [1.2]"),
        (lambda: success_by([float("nan")], [True], [0, 1]), "found [nan]"),
        (lambda: success_by([0.1], [True, False], [0, 1]), "other episodes"),
        (lambda: success_by([0.1], [True], [1, 0]), "ascending"),
    ],
)
def test_what_is_no_evaluation_is_an_error(call, words):
    with pytest.raises(EvaluationError) as error:
        call()
    assert words in str(error.value)


def test_another_package_says_the_same():
    robostats = pytest.importorskip("robostats")
    for n in (1, 2, 10, 39, 200):
        for k in {0, 1, n // 3, n - 1, n}:
            theirs = robostats.clopper_pearson(k, n)
            assert (share(k, n).low, share(k, n).high) == pytest.approx((theirs.lower, theirs.upper), abs=1e-12)
    for counts in [(20, 8, 5, 7), (59, 6, 16, 80), (0, 12, 0, 0), (9, 0, 0, 4), (3, 0, 6, 1), (0, 4, 4, 0)]:
        table = robostats.PairedResult("a", "b", *counts, tuple(map(str, range(sum(counts)))), 0, 0, ("",), ("",), None)
        theirs, ours = robostats.compare(table), compare_counts(*counts)
        assert ours.p_value == pytest.approx(theirs.p_value, abs=1e-12)
        assert (ours.low, ours.high) == pytest.approx((theirs.interval.lower, theirs.interval.upper), abs=1e-10)
    kmodel = pytest.importorskip("robostats.kmodel")
    for p_values in ([0.01, 0.04, 0.03, 0.005], [0.2, 0.2, 0.9], [0.001]):
        assert holm(p_values) == pytest.approx(kmodel.adjust(p_values, "holm"), abs=1e-15)
