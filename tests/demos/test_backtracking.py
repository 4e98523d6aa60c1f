"""Which candidate is due, as it is asked for and told: no process is forked, nothing is run again."""

from __future__ import annotations

import pytest
from branch_notes import Notes

from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.demos.backtracking import DeadEnd, turns
from robocas_ms3.planning.decisions import Effort


def play(candidates, scores, effort, notes=None):
    """What is looked at (a) and gone on from (A), each of which fails, and how it ends."""
    order, outcome, taken = turns(candidates, effort, notes or Notes()), None, ""
    with pytest.raises((DeadEnd, PlanningFailed)) as end:
        while True:
            candidate, go_on = order.send(outcome)
            taken += candidate.upper() if go_on else candidate
            outcome = None if go_on else scores.get(candidate, PlanningFailed("play", candidate))
            if go_on and notes:
                notes.failed(PlanningFailed("end", candidate))
    return taken, str(end.value)


def test_a_few_are_compared_and_gone_on_from_the_best_first():
    scores = {"a": 1.0, "b": 3.0, "d": 2.0, "e": 5.0}
    assert play("abcde", scores, Effort(ahead=2, tries=9)) == ("abBAcdeED", "")
    assert play("abcde", scores, Effort(ahead=2, tries=3)) == ("abBAcdeE", "")
    assert play("abcde", scores, Effort(ahead=9, tries=2, enough=3.0)) == ("abBA", "")


def test_an_attempt_too_many_ends_it():
    assert play("abc", dict.fromkeys("abc", 0.0), Effort(ahead=3), Notes(max_attempts=2)) == ("abcAB", "")


def test_where_none_can_be_played_the_last_failure_says_why():
    assert play("ab", {}, Effort()) == ("ab", "play: b")
    assert play("", {}, Effort()) == ("", "decision: no_candidate")


def test_candidates_are_taken_as_they_are_needed():
    def candidates():
        yield "a"
        raise AssertionError("nobody asked for another")

    order = turns(candidates(), Effort(tries=1), Notes())
    assert order.send(None) == ("a", False)
    assert order.send(0.0) == ("a", True)
    with pytest.raises(DeadEnd):
        order.send(None)
