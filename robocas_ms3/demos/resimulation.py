"""Decisions where a process can't be forked: a moment is come back to by running the attempt again from its reset.

The same candidates are played as in `branches`, in the same order, so that the episodes are the same; only slower.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TypeVar

from robocas_ms3.demos.branches import Tally, Undone
from robocas_ms3.errors import PlanningFailed
from robocas_ms3.planning.decisions import ONE_BY_ONE, Effort

T = TypeVar("T")


class _Again(Exception):  # noqa: N818
    """Run the attempt again: the next candidate of a decision is due."""


@dataclass
class _Decision:
    """What is known of a decision.

    Attributes:
        next: index of the first candidate that has not been played.
        played: score and index of those that are being compared.
        ranked: indices of those that may be gone on from, the best first.
        on: index of the one that is gone on from.
        gone_on: how many were gone on from.
        failure: of the candidate that came last.
    """

    next: int = 0
    played: list[tuple[float, int]] = field(default_factory=list)
    ranked: list[int] = field(default_factory=list)
    on: int | None = None
    gone_on: int = 0
    failure: PlanningFailed = field(default_factory=lambda: PlanningFailed("decision", "no_candidate"))

    def rank(self) -> None:
        """End a comparison."""
        self.ranked = [index for _, index in sorted(self.played, key=lambda found: -found[0])]
        self.played = []

    def go_on(self) -> int:
        """Take the best one left."""
        self.on = self.ranked.pop(0)
        self.gone_on += 1
        return self.on


class Resimulation:
    """Makes decisions by running attempts again.

    Args:
        tally: of the episode.
    """

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._made: list[_Decision] = []
        self._depth = 0

    def run(self, attempt: Callable[[], None]) -> bool:
        """Run an attempt; see `branches.BranchingDecisions`."""
        self._made = []
        while True:
            self._depth = 0
            try:
                attempt()
                return True
            except _Again:
                continue
            except PlanningFailed as error:
                self._tally.failed(error)
            except Undone:
                self._made.pop()
            # the last decision whose candidate was gone on from is made otherwise
            while self._made and self._made[-1].on is None:
                self._made.pop()
            if not self._made:
                return False
            self._made[-1].on = None

    def choose(self, candidates: Iterable[T], play: Callable[[T], float], effort: Effort = ONE_BY_ONE) -> T:
        """Choose; see `planning.decisions`."""
        if self._depth == len(self._made):
            self._made.append(_Decision())
        decision, items = self._made[self._depth], list(candidates)
        self._depth += 1
        if decision.on is None:
            if decision.gone_on == effort.tries or (decision.gone_on and self._tally.exhausted):
                raise Undone
            if not decision.ranked and self._look(decision, items, play, effort):
                return items[decision.go_on()]
            decision.go_on()
        assert decision.on is not None
        play(items[decision.on])
        return items[decision.on]

    def _look(self, decision: _Decision, items: list[T], play: Callable[[T], float], effort: Effort) -> bool:
        """Play the next candidate; say whether it is the best of a comparison that ends with it, so that it stands.

        Returns False, with nothing played, where there is no next one and the comparison ends.
        """
        index = decision.next
        if index == len(items):
            decision.rank()
            if not decision.ranked:
                raise Undone if decision.gone_on else decision.failure
            return False
        decision.next += 1
        try:
            decision.played.append((play(items[index]), index))
        except PlanningFailed as error:
            decision.failure = error
            raise _Again from error
        if len(decision.played) == effort.ahead or decision.played[-1][0] >= effort.enough:
            decision.rank()
            if decision.ranked[0] == index:
                return True
        raise _Again
