"""Decisions where a process can't be forked: the attempt is run again from its reset up to the decision.

The same candidates are played as in `branches`, in the same order, so the episodes are the same; only slower.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import TypeVar

from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.demos.backtracking import DeadEnd, turns
from robocas_ms3.demos.ledger import EpisodeResult
from robocas_ms3.planning.decisions import ONE_BY_ONE, Effort

T = TypeVar("T")


class _Rerun(Exception):  # noqa: N818
    """Run the attempt again: another candidate of a decision is next."""


class _Decision:
    """A decision that attempts come to again and again.

    Args:
        turns: of its candidates, by their indices.

    Attributes:
        next: the turn to be taken, or why there is none.
        chosen: index of the candidate that the episode continues from, if any.
    """

    def __init__(self, turns: Generator[tuple[int, bool], float | PlanningFailed | None, None]) -> None:
        self._turns = turns
        self.advance()

    def advance(self, outcome: float | PlanningFailed | None = None) -> None:
        """Take the outcome of a turn, and the next turn; see `backtracking.turns`."""
        self.chosen: int | None = None
        try:
            self.next: tuple[int, bool] | Exception = self._turns.send(outcome)
        except (PlanningFailed, DeadEnd) as error:
            self.next = error


class Resimulation:
    """Makes decisions by running attempts again."""

    def __init__(self, result: EpisodeResult) -> None:
        self._result = result
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
                self._result.failed(error)
            except DeadEnd:
                self._decisions.pop()
            # the last decision that the episode continued from is made otherwise
            while self._decisions and self._decisions[-1].chosen is None:
                self._decisions.pop()
            if not self._decisions:
                return False
            self._decisions[-1].advance()

    def choose(self, candidates: Iterable[T], play: Callable[[T], float], effort: Effort = ONE_BY_ONE) -> T:
        """Choose; see `Decisions`."""
        items = list(candidates)
        if self._depth == len(self._decisions):
            self._decisions.append(_Decision(turns(range(len(items)), effort, self._result)))
        decision = self._decisions[self._depth]
        self._depth += 1
        if decision.chosen is None:
            if isinstance(decision.next, Exception):
                raise decision.next
            index, continues = decision.next
            if not continues:
                try:
                    outcome = play(items[index])
                except PlanningFailed as error:
                    outcome = error
                decision.advance(outcome)
                if decision.next != (index, True):
                    raise _Rerun
                decision.chosen = index  # what was played stands
                return items[index]
            decision.chosen = index
        play(items[decision.chosen])
        return items[decision.chosen]
