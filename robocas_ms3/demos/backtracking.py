"""Order in which the candidates of a decision are tried, and backtracking without forked processes.

`ForkedDecisions` (`demos.branches`) returns to a decision by forking the process there. `ResimulatedDecisions` returns
to it by running the attempt again from its reset. Both try the same candidates in the same order and give the same
episodes; the second is slower.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from copy import deepcopy
from typing import Any, TypeVar

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.demos.failures import EpisodeResult
from robocas_ms3.planning.decisions import FIRST_FEASIBLE, SearchLimits

T = TypeVar("T")


class CandidatesExhaustedError(Exception):
    """The episode failed with each candidate of a decision.

    The search must backtrack to the previous decision.

    `EpisodeResult.failures` contains the failures already.
    """


def order_candidates(
    candidates: Iterable[T], limits: SearchLimits, result: EpisodeResult
) -> Generator[tuple[T, bool], float | PlanningError | None, None]:
    """Yield the candidates of a decision in search order, each with a flag.

    The flag says what the caller has to do.

    False: run the candidate, and send its score, or the PlanningError of its motions.
    True: continue the episode from the candidate. If the episode fails, send None.

    First ``limits.max_compared_candidates`` candidates are scored. The episode continues from the best of them, then
    from the second best, and so on. Then the next candidates are scored.

    Args:
        candidates: candidates of the decision, evaluated lazily.
        limits: numbers of candidates to compare and to continue from.
        result: result of the episode, whose number of failed attempts can end the search.

    Raises:
        CandidatesExhaustedError: the episode has failed with as many candidates as ``limits`` or the maximum number of
            attempts allow.
        PlanningError: no candidate is feasible; the error of the last candidate.
    """
    failure, continued, remaining = PlanningError("decision", "no_candidate"), 0, iter(candidates)
    while continued < limits.max_continued_candidates and not result.has_no_attempts_left:
        scored: list[tuple[float, T]] = []
        for candidate in remaining:
            outcome = yield candidate, False
            if isinstance(outcome, PlanningError):
                failure = outcome
                continue
            assert outcome is not None
            scored.append((outcome, candidate))
            if len(scored) == limits.max_compared_candidates or outcome >= limits.sufficient_score:
                break
        if not scored:
            break
        for _, candidate in sorted(scored, key=lambda pair: -pair[0]):
            yield candidate, True
            continued += 1
            if continued == limits.max_continued_candidates or result.has_no_attempts_left:
                break
    raise CandidatesExhaustedError if continued else failure


class _RestartAttempt(Exception):  # noqa: N818
    """Signal to run the attempt again from its reset, with another candidate of a decision."""


class _Decision:
    """State of a decision, which is kept while the attempt is simulated again.

    Args:
        items: candidates. They are kept, since their order may depend on earlier failures of the seed.
        limits: numbers of candidates to compare and to continue from.
        result: result of the episode.

    Attributes:
        items: candidates.
        next: index of the next candidate and flag of `order_candidates`, or the error that ends the decision.
        chosen: index of the candidate from which the episode continues; None while no candidate is chosen.
    """

    def __init__(self, items: list[Any], limits: SearchLimits, result: EpisodeResult) -> None:
        self.items = items
        self._order = order_candidates(range(len(items)), limits, result)
        self.advance()

    def advance(self, outcome: float | PlanningError | None = None) -> None:
        """Send the outcome of the present candidate to `order_candidates`, and fetch the next candidate."""
        self.chosen: int | None = None
        try:
            self.next: tuple[int, bool] | Exception = self._order.send(outcome)
        except (PlanningError, CandidatesExhaustedError) as error:
            self.next = error


class ResimulatedDecisions:
    """Decisions that undo motions by simulating the attempt again from its reset.

    The class has the same methods as `ForkedDecisions` and gives the same episodes, but is slower.
    """

    def __init__(self, result: EpisodeResult) -> None:
        self._result = result
        self._decisions: list[_Decision] = []
        self._depth = 0

    def run(self, attempt: Callable[[], None]) -> bool:
        """Run an attempt from its reset with backtracking; return whether it succeeded.

        ``attempt`` resets the environment, runs the policy and writes the episode.
        """
        self._decisions = []
        while True:
            self._depth = 0
            try:
                attempt()
                return True
            except _RestartAttempt:
                continue
            except PlanningError as error:
                self._result.add_failure(error)
            except CandidatesExhaustedError:
                self._decisions.pop()
            # backtrack to the last decision that the episode continued from
            while self._decisions and self._decisions[-1].chosen is None:
                self._decisions.pop()
            if not self._decisions:
                return False
            self._decisions[-1].advance()

    def choose(
        self, candidates: Iterable[T], run_candidate: Callable[[T], float], limits: SearchLimits = FIRST_FEASIBLE
    ) -> T:
        if self._depth == len(self._decisions):
            self._decisions.append(_Decision(list(candidates), limits, self._result))
        decision = self._decisions[self._depth]
        items = decision.items
        self._depth += 1
        if decision.chosen is None:
            if isinstance(decision.next, Exception):
                raise decision.next
            index, continues = decision.next
            if not continues:
                try:
                    outcome = run_candidate(items[index])
                except PlanningError as error:
                    outcome = error
                decision.advance(outcome)
                if decision.next != (index, True):
                    raise _RestartAttempt
                decision.chosen = index  # the candidate that has just run is the best one: keep its motions
                return items[index]
            decision.chosen = index
        experience = deepcopy(self._result.experience)
        run_candidate(items[decision.chosen])
        self._result.experience.restore(experience)  # later results of the same move are the ones that count
        return items[decision.chosen]
