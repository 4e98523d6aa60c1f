"""Backtracking by forking and by simulating again, with a list of letters as the simulator."""

from __future__ import annotations

import pytest
from branch_notes import Notes

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.demos.backtracking import CandidatesExhaustedError, ResimulatedDecisions, order_candidates
from robocas_ms3.demos.branches import ForkedDecisions
from robocas_ms3.planning.decisions import IrreversibleDecisions, SearchLimits

RUNNERS = [ForkedDecisions, ResimulatedDecisions]


class World:
    """Simulator stand-in whose state is the sequence of actions since the reset."""

    def __init__(self) -> None:
        self.done = ""

    def act(self, letter: str) -> None:
        self.done += letter


def search(decide, good):
    """Run an attempt with `decide`; return success, outcome and failures."""
    found = []
    for make in RUNNERS:
        notes, world = Notes(), World()
        runner = make(notes)

        def attempt(world=world, runner=runner, notes=notes):
            world.done = ""
            decide(world, runner)
            if world.done not in good:
                raise PlanningError("end", world.done)
            notes.outcome = world.done

        ended = runner.run(attempt)
        found.append((ended, notes.outcome, notes.texts))
    assert found[0] == found[1], "both ways come to the same"
    return found[0]


A_FEW, ALL = {"a": 1.0, "b": 3.0, "c": 2.0}, {"a": 1.0, "b": 2.0, "c": 3.0}  # scores of the last letter


@pytest.mark.parametrize(
    ("good", "limits", "scores", "outcome", "failures"),
    [
        ("bc", SearchLimits(), None, "bc", "aa ab ac ba bb"),  # what failed leaves no trace
        ("", SearchLimits(), None, "", "aa ab ac ba bb bc ca cb cc"),
        ("ba", SearchLimits(max_continued_candidates=2), None, "ba", "aa ab"),  # backtrack after some candidates
        ("cb bc", SearchLimits(max_compared_candidates=3), A_FEW, "bc", "bb"),  # from the best of those compared first
        (
            "cc",
            SearchLimits(max_compared_candidates=2, max_continued_candidates=9),
            ALL,
            "cc",
            "bb ba bc ab aa ac cb ca",
        ),  # the next two
    ],
)
def test_candidates_are_tried_in_order_until_the_attempt_succeeds(good, limits, scores, outcome, failures):
    def decide(world, runner):
        def play(letter):
            world.act(letter)
            return scores[letter] if scores else 0.0

        for _ in range(2):
            runner.choose("abc", play, limits)

    found = search(decide, set(good.split()))
    assert found == (bool(outcome), outcome, [f"end: {end}" for end in failures.split()])


def test_order_may_depend_on_earlier_failures():
    """A letter that failed is the last in later decisions, whichever class undoes the motions."""
    runs = []
    for make in RUNNERS:
        notes, world = Notes(), World()
        runner = make(notes)

        def attempt(world=world, runner=runner, notes=notes):
            world.done = ""
            for _ in range(2):
                letters = sorted("abc", key=lambda letter: notes.experience.failed_checks[letter])
                letter = runner.choose(letters, lambda letter: world.act(letter) or 0.0)
            notes.experience.failed_checks[letter] += 1
            raise PlanningError("end", world.done)

        runner.run(attempt)
        runs.append((notes.texts, dict(notes.experience.failed_checks)))
    assert runs[0] == runs[1]
    assert runs[0][0] == [f"end: {first}{second}" for first in "abc" for second in "abc"]
    assert runs[0][1] == {"a": 3, "b": 3, "c": 3}


def test_repeated_moves_do_not_change_the_experience():
    """The gain of a letter is that of its last simulation, whichever class undoes the motions."""
    runs = []
    for make in RUNNERS:
        notes, world = Notes(), World()
        runner = make(notes)

        def act(letter, world=world, notes=notes):
            notes.experience.gains[letter] = len(world.done)  # other gains at other depths
            return world.act(letter) or 0.0

        def attempt(world=world, runner=runner, notes=notes, act=act):
            world.done = ""
            for _ in range(3):
                runner.choose(sorted("abc", key=lambda letter: (notes.experience.gains.get(letter, 9), letter)), act)
            raise PlanningError("end", f"{world.done} {sorted(notes.experience.gains.items())}")

        runner.run(attempt)
        runs.append(notes.texts)
    assert runs[0] == runs[1]
    assert len(runs[0]) == 27


def test_sufficient_score_ends_the_comparison():
    scores = {"a": 1.0, "b": 5.0, "c": 9.0}

    def decide(world, runner):
        runner.choose(
            "abc",
            lambda letter: (world.act(letter), scores[letter])[1],
            SearchLimits(max_compared_candidates=3, sufficient_score=4),
        )

    assert search(decide, {"b"}) == (True, "b", [])


def test_infeasible_candidate_is_skipped():
    def decide(world, runner):
        def play(letter):
            world.act(letter)
            if letter != "c":
                raise PlanningError("play", letter)
            return 0.0

        runner.choose("abcd", play, SearchLimits(max_compared_candidates=2))
        world.act("!")

    assert search(decide, {"c!"}) == (True, "c!", [])


def test_policy_may_continue_without_a_feasible_candidate():
    def decide(world, runner):
        def no(letter):
            world.act(letter)
            raise PlanningError("play", letter)

        with pytest.raises(PlanningError, match="play: b"):
            runner.choose("ab", no)
        assert world.done == "", "what could not be done is undone"
        runner.choose("xy", lambda letter: (world.act(letter), 0.0)[1])

    assert search(decide, {"y"}) == (True, "y", ["end: x"])


def test_irreversible_decisions_take_the_first_feasible_candidate():
    world = World()

    def play(letter):
        if letter == "a":
            raise PlanningError("play", letter)
        world.act(letter)
        if letter == "c":
            raise PlanningError("late", letter)
        return 0.0

    straight = IrreversibleDecisions(lambda: len(world.done))
    assert straight.choose("ab", play) == "b"
    with pytest.raises(PlanningError, match="late: c"):
        straight.choose("cb", play)
    assert world.done == "bc"


def test_candidates_are_evaluated_lazily():
    def candidates():
        yield "a"
        raise AssertionError("nobody asked for another")

    order = order_candidates(candidates(), SearchLimits(max_continued_candidates=1), Notes())
    assert order.send(None) == ("a", False)
    assert order.send(0.0) == ("a", True)
    with pytest.raises(CandidatesExhaustedError):
        order.send(None)


def test_failed_attempts_are_counted():
    order = order_candidates("abc", SearchLimits(), notes := Notes(max_attempts=1))
    assert (next(order), order.send(0.0)) == (("a", False), ("a", True))
    notes.add_failure(PlanningError("end", "a"))
    with pytest.raises(CandidatesExhaustedError):
        order.send(None)
