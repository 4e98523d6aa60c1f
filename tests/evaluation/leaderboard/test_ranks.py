"""Ranks of policies by paired tests."""

import pytest

from robocas_ms3.evaluation.leaderboard.ranks import Rank, rank_policies


def successes(*solved, n=20):
    return {episode: episode in solved for episode in range(n)}


def test_a_significantly_worse_policy_has_a_lower_rank():
    # 12 episodes that only the first solves: p = 2 / 2**12
    first, second = rank_policies([successes(*range(12)), successes()])
    assert first == Rank(1, pytest.approx(2 / 2**12)) and second == Rank(2, None)


def test_differences_that_are_not_significant_are_ties():
    # 5 episodes that only the first solves: p = 2 / 2**5 = 0.0625
    assert [one.rank for one in rank_policies([successes(*range(5)), successes()])] == [1, 1]


def test_p_values_are_adjusted_for_all_pairs():
    # two pairs with 7 against 0, p = 2 / 2**7 = 0.0156 each, and one pair of equal policies, p = 1
    a, b, c = rank_policies([successes(*range(7)), successes(*range(7)), successes()])
    assert (a.rank, b.rank, c.rank) == (1, 1, 3)
    assert b.p_value == pytest.approx(3 * 2 / 2**7)  # Holm: the second smallest of three is at least the first
    # 6 against 0: p = 0.03125 is significant alone, but not three times
    assert [one.rank for one in rank_policies([successes(*range(6)), successes(*range(6)), successes()])] == [1, 1, 1]


def test_only_common_episodes_are_compared():
    other = {episode: False for episode in range(100, 120)}
    assert rank_policies([successes(*range(20)), other]) == [Rank(1, None), Rank(1, None)]
    assert rank_policies([successes(1)]) == [Rank(1, None)] and rank_policies([]) == []
