"""Decisions of a scripted policy, and where the time of its episode goes.

A decision is a list of candidates, a function that plays one and returns its score, and a `Decisions` that tries them
and continues from the best: `demos.branches` undoes what was tried, `StraightDecisions` can't.
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
TRIES = 3  # candidates of one decision that are gone on from before the decision before it is made otherwise


@dataclass(frozen=True)
class Effort:
    """How many candidates are tried for a decision.

    Attributes:
        ahead: feasible candidates that are compared before the episode continues from the best.
        tries: candidates that the episode continues from, before the decision is given up.
        enough: a score at which no other candidate is played.
    """

    ahead: int = 1
    tries: int = TRIES
    enough: float = math.inf


ONE_BY_ONE = Effort()  # the first that can be done, then the next


class Decisions(Protocol):
    """Plays candidates and goes on from one of them."""

    def choose(self, candidates: Iterable[T], play: Callable[[T], float], effort: Effort = ONE_BY_ONE) -> T:
        """Play candidates from this moment on and continue from the one with the greatest score.

        If a later step fails, the policy is back here and continues from the next best one, as if the first had never
        been tried.

        Args:
            candidates: the most promising first.
            play: makes a candidate's motions and returns its score; raises ``PlanningError`` where it can't be done.
            effort: how many are compared, and continued from.

        Returns:
            The candidate that was played, its motions done.

        Raises:
            PlanningError: of the last candidate, where none can be done; nothing has moved then.
        """
        ...


@dataclass(frozen=True)
class StraightDecisions:
    """Takes the first candidate that can be played and never undoes anything.

    Attributes:
        done: number of actions so far; a candidate that fails after some leaves no way to the next.
    """

    done: Callable[[], int]

    def choose(self, candidates: Iterable[T], play: Callable[[T], float], effort: Effort = ONE_BY_ONE) -> T:
        failure = PlanningError("decision", "no_candidate")
        for candidate in candidates:
            before = self.done()
            try:
                play(candidate)
                return candidate
            except PlanningError as error:
                failure = error
                if self.done() > before:
                    raise
        raise failure


@dataclass
class Seconds:
    """Where an episode's time went: CPU seconds of this process and of all its branches that could be played."""

    reset: float = 0.0
    planning: float = 0.0
    simulation: float = 0.0
    check: float = 0.0

    @contextmanager
    def spent_on(self, part: str) -> Iterator[None]:
        start = time.process_time()
        try:
            yield
        finally:
            setattr(self, part, getattr(self, part) + time.process_time() - start)
