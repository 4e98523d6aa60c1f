"""The order in which the candidates of a decision are tried, and decisions where a process can't be forked.

`branches` comes back to the moment of a decision by forking there, `Resimulation` by running the attempt again from its
reset. Both play the same candidates in the same order, so the episodes are the same; the second is only slower.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import TypeVar

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.demos.failures import EpisodeResult
from robocas_ms3.planning.decisions import ONE_BY_ONE, Effort

T = TypeVar("T")


class DeadEnd(Exception):  # noqa: N818
    """All candidates failed later, and their failures are noted: the decision before must be made otherwise."""


def turns(
    candidates: Iterable[T], effort: Effort, result: EpisodeResult
) -> Generator[tuple[T, bool], float | PlanningError | None, None]:
    """Yield which candidate is next, and whether to continue from it, or only to play it for its score.

    A few are compared, and the episode continues from the best first; then from the next few. The caller sends the
    score of a played candidate, or why it can't be played; nothing after continuing, which has failed then.

    Args:
        candidates: of a decision, taken as they are needed.
        effort: how many are compared and continued from.
        result: of the episode so far.

    Raises:
        DeadEnd: the episode continued from some candidates, and from no other it shall.
        PlanningError: none can be played; of the last one.
    """
    failure, continued, left = PlanningError("decision", "no_candidate"), 0, iter(candidates)
    while continued < effort.tries and not result.exhausted:
        compared: list[tuple[float, T]] = []
        for candidate in left:
            outcome = yield candidate, False
            if isinstance(outcome, PlanningError):
                failure = outcome
                continue
            assert outcome is not None
            compared.append((outcome, candidate))
            if len(compared) == effort.ahead or outcome >= effort.enough:
                break
        if not compared:
            break
        for _, candidate in sorted(compared, key=lambda scored: -scored[0]):
            yield candidate, True
            continued += 1
            if continued == effort.tries or result.exhausted:
                break
    raise DeadEnd if continued else failure


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

    def __init__(self, turns: Generator[tuple[int, bool], float | PlanningError | None, None]) -> None:
        self._turns = turns
        self.advance()

    def advance(self, outcome: float | PlanningError | None = None) -> None:
        """Take the outcome of a turn, and the next turn; see `backtracking.turns`."""
        self.chosen: int | None = None
        try:
            self.next: tuple[int, bool] | Exception = self._turns.send(outcome)
        except (PlanningError, DeadEnd) as error:
            self.next = error


class Resimulation:
    """Makes decisions by running attempts again from the reset; methods as `branches.ForkedBranches`."""

    def __init__(self, result: EpisodeResult) -> None:
        self._result = result
        self._decisions: list[_Decision] = []
        self._depth = 0

    def run(self, attempt: Callable[[], None]) -> bool:
        self._decisions = []
        while True:
            self._depth = 0
            try:
                attempt()
                return True
            except _Rerun:
                continue
            except PlanningError as error:
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
                except PlanningError as error:
                    outcome = error
                decision.advance(outcome)
                if decision.next != (index, True):
                    raise _Rerun
                decision.chosen = index  # what was played stands
                return items[index]
            decision.chosen = index
        play(items[decision.chosen])
        return items[decision.chosen]
