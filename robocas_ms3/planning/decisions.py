"""Decisions of a scripted policy (backtracking search), and CPU seconds per part of an episode.

A decision has candidates, a function that plays a candidate and returns its score, and a `Decisions` object that plays
candidates and continues from the best one. The classes in `demos.branches` and `demos.backtracking` undo the motions of
the other candidates; `IrreversibleDecisions` cannot.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, TypeVar

from robocas_ms3.core.errors import PlanningError

T = TypeVar("T")
MAX_CONTINUED = 3  # candidates of a decision to continue from, before the search backtracks to the previous decision


@dataclass(frozen=True)
class SearchLimits:
    """Limits on the number of candidates that are tried for a decision.

    Attributes:
        compared: feasible candidates that are scored before the episode continues from the best one.
        max_continued: candidates to continue from, before the search backtracks to the previous decision.
        sufficient_score: score from which on no further candidate is compared.
    """

    compared: int = 1
    max_continued: int = MAX_CONTINUED
    sufficient_score: float = math.inf


FIRST_FEASIBLE = SearchLimits()
"""Continue from the first feasible candidate, and after a failure from the next one, without comparing scores."""


class Decisions(Protocol):
    """Interface for decisions of a scripted policy: run candidate motions, continue from the best one."""

    def choose(self, candidates: Iterable[T], play: Callable[[T], float], limits: SearchLimits = FIRST_FEASIBLE) -> T:
        """Play candidates from the current state and continue from the one with the greatest score.

        If a later step fails, the search returns to this state and continues from the next best candidate.

        Args:
            candidates: candidates, the most promising first.
            play: function that runs the motions of a candidate and returns its score; it raises PlanningError if the
                candidate is not feasible.
            limits: numbers of candidates to compare and to continue from.

        Returns:
            The chosen candidate; its motions have been run.

        Raises:
            PlanningError: no candidate is feasible; the error of the last one. Nothing has moved.
        """
        ...


@dataclass(frozen=True)
class IrreversibleDecisions:
    """Decisions that take the first feasible candidate and never undo motions.

    Attributes:
        count_actions: function that returns the number of actions so far. After a candidate that fails with actions
            done, no other candidate is played.
    """

    count_actions: Callable[[], int]

    def choose(self, candidates: Iterable[T], play: Callable[[T], float], limits: SearchLimits = FIRST_FEASIBLE) -> T:
        failure = PlanningError("decision", "no_candidate")
        for candidate in candidates:
            before = self.count_actions()
            try:
                play(candidate)
                return candidate
            except PlanningError as error:
                failure = error
                if self.count_actions() > before:
                    raise
        raise failure


@dataclass
class Seconds:
    """CPU seconds of an episode by part, including child processes of feasible candidates."""

    reset: float = 0.0
    planning: float = 0.0
    simulation: float = 0.0
    check: float = 0.0

    @contextmanager
    def measure(self, part: str) -> Iterator[None]:
        """Add the CPU seconds of a ``with`` block to a part."""
        start = time.process_time()
        try:
            yield
        finally:
            setattr(self, part, getattr(self, part) + time.process_time() - start)
