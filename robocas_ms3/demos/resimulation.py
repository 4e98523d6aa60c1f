"""Decisions where a process can't be forked: a moment is come back to by running the attempt again from its reset.

The same candidates are played as in `branches`, in the same order, so that the episodes are the same; only slower.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import TypeVar

from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.demos.backtracking import DeadEnd, Tally, turns
from robocas_ms3.planning.decisions import ONE_BY_ONE, Effort

T = TypeVar("T")


class _Rerun(Exception):  # noqa: N818
    """Run the attempt again: the next candidate of a decision is due."""


class _Decision:
    """A decision that attempts come by again and again.

    Args:
        turns: of its candidates, by their indices.

    Attributes:
        due: the turn to be taken, or why there is none.
        on: index of the candidate that is gone on from, if any is.
    """

    def __init__(self, turns: Generator[tuple[int, bool], float | PlanningFailed | None, None]) -> None:
        self._turns = turns
        self.make_otherwise()

    def make_otherwise(self, outcome: float | PlanningFailed | None = None) -> None:
        """Take note of what came of a turn; see `backtracking.turns`."""
        self.on: int | None = None
        try:
            self.due: tuple[int, bool] | Exception = self._turns.send(outcome)
        except (PlanningFailed, DeadEnd) as error:
            self.due = error


class Resimulation:
    """Makes decisions by running attempts again.

    Args:
        tally: of the episode.
    """

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._decisions: list[_Decision] = []
        self._depth = 0

    def run(self, attempt: Callable[[], None]) -> bool:
        """Run an attempt; see `branches.ForkedBranches`."""
        self._decisions = []
        while True:
            self._depth = 0
            try:
                attempt()
                return True
            except _Rerun:
                continue
            except PlanningFailed as error:
                self._tally.failed(error)
            except DeadEnd:
                self._decisions.pop()
            # the last decision whose candidate was gone on from is made otherwise
            while self._decisions and self._decisions[-1].on is None:
                self._decisions.pop()
            if not self._decisions:
                return False
            self._decisions[-1].make_otherwise()

    def choose(self, candidates: Iterable[T], play: Callable[[T], float], effort: Effort = ONE_BY_ONE) -> T:
        """Choose; see `planning.decisions`."""
        items = list(candidates)
        if self._depth == len(self._decisions):
            self._decisions.append(_Decision(turns(range(len(items)), effort, self._tally)))
        decision = self._decisions[self._depth]
        self._depth += 1
        if decision.on is None:
            if isinstance(decision.due, Exception):
                raise decision.due
            index, go_on = decision.due
            if not go_on:
                decision.make_otherwise(_outcome(play, items[index]))
                if decision.due != (index, True):
                    raise _Rerun
                decision.on = index  # what was done stands
                return items[index]
            decision.on = index
        play(items[decision.on])
        return items[decision.on]


def _outcome(play: Callable[[T], float], candidate: T) -> float | PlanningFailed:
    try:
        return play(candidate)
    except PlanningFailed as error:
        return error
