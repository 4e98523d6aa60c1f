"""Decisions of a scripted policy (backtracking search), and CPU seconds per phase of an episode.

A decision has candidates, for example grasps. The policy passes the candidates and a function that runs one candidate
to `Decisions.choose`. Three classes implement this interface. The classes in `demos.branches` and `demos.backtracking`
undo the motions of rejected candidates; `IrreversibleDecisions` cannot undo motions.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from robocas_ms3.core.errors import PlanningError

T = TypeVar("T")
MAX_CONTINUED_CANDIDATES = 3
WITH_NOISE = "_with_noise"  # suffix of the reasons of open-loop checks that failed only with noise


@dataclass(frozen=True)
class SearchLimits:
    """Limits on the candidates that a decision tries.

    Attributes:
        max_compared_candidates: number of feasible candidates to score before the episode continues from the best.
        max_continued_candidates: number of candidates that the episode continues from, one after the other, before the
            search backtracks to the previous decision.
        sufficient_score: a candidate with at least this score ends the comparison.
    """

    max_compared_candidates: int = 1
    max_continued_candidates: int = MAX_CONTINUED_CANDIDATES
    sufficient_score: float = math.inf


FIRST_FEASIBLE = SearchLimits()
"""Continue from the first feasible candidate; if the episode fails later, continue from the next feasible one."""


class Decisions(Protocol):
    """Interface for the decisions of a scripted policy."""

    def choose(
        self, candidates: Iterable[T], run_candidate: Callable[[T], float], limits: SearchLimits = FIRST_FEASIBLE
    ) -> T:
        """Run candidates from the current state and continue from the candidate with the greatest score.

        If a later motion fails, the search returns to this state and continues from the next best candidate.

        Args:
            candidates: candidates, the most promising first.
            run_candidate: function that runs the motions of a candidate and returns its score. It raises
                PlanningError if the candidate is not feasible.
            limits: numbers of candidates to compare and to continue from.

        Returns:
            The chosen candidate. Its motions have been executed.

        Raises:
            PlanningError: no candidate is feasible. The error is that of the last candidate.
        """
        ...


@dataclass(frozen=True)
class IrreversibleDecisions:
    """Decisions that continue from the first feasible candidate and never undo motions.

    A candidate that fails after it has executed actions ends the decision with its error.

    Attributes:
        count_actions: function that returns the number of actions since the reset.
    """

    count_actions: Callable[[], int]

    def choose(
        self, candidates: Iterable[T], run_candidate: Callable[[T], float], limits: SearchLimits = FIRST_FEASIBLE
    ) -> T:
        failure = PlanningError("decision", "no_candidate")
        for candidate in candidates:
            before = self.count_actions()
            try:
                run_candidate(candidate)
                return candidate
            except PlanningError as error:
                failure = error
                if self.count_actions() > before:
                    raise
        raise failure


@dataclass
class MoveExperience:
    """Results of the moves that were simulated at a seed, in all attempts; later decisions use them.

    Attributes:
        failed_checks: number of open-loop checks that failed without noise after each kind of move.
        gains: cost that each move saved when it was last simulated, s; -inf if it was not feasible.
        dead_ends: number of states in which neither a move nor a grasp of the target was feasible.
    """

    failed_checks: Counter[Hashable] = field(default_factory=Counter)
    gains: dict[Hashable, float] = field(default_factory=dict)
    dead_ends: int = 0

    def merge(self, other: MoveExperience) -> None:
        """Add the experience of a forked process."""
        self.failed_checks |= other.failed_checks
        self.gains.update(other.gains)
        self.dead_ends = max(self.dead_ends, other.dead_ends)

    def restore(self, earlier: MoveExperience) -> None:
        """Return to an earlier state, in place."""
        vars(self).update(vars(earlier))


@dataclass
class CpuSeconds:
    """CPU seconds of an episode by phase, including the child processes of feasible candidates.

    Attributes:
        reset: resets of the environments.
        planning: motion planning.
        simulation: steps of the recorded environment.
        check: open-loop checks.
        candidates: candidates that are simulated for candidates.h5, including their processes.
    """

    reset: float = 0.0
    planning: float = 0.0
    simulation: float = 0.0
    check: float = 0.0
    candidates: float = 0.0

    @contextmanager
    def measure(self, phase: str) -> Iterator[None]:
        """Add the CPU seconds of a ``with`` block to a phase, given by the name of its attribute."""
        start = time.process_time()
        try:
            yield
        finally:
            setattr(self, phase, getattr(self, phase) + time.process_time() - start)
