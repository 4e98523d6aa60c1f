"""The order in which the candidates of a decision are tried, and when the decision is given up.

`branches` comes back to the moment of a decision by forking there, `resimulation` by running the attempt again from its
reset. Both play the same candidates in the same order, so the episodes are the same.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from typing import TypeVar

from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.demos.ledger import EpisodeResult
from robocas_ms3.planning.decisions import Effort

T = TypeVar("T")


class DeadEnd(Exception):  # noqa: N818
    """All candidates failed later, and their failures are noted: the decision before must be made otherwise."""


def turns(
    candidates: Iterable[T], effort: Effort, result: EpisodeResult
) -> Generator[tuple[T, bool], float | PlanningFailed | None, None]:
    """Yield which candidate is next, and whether to continue from it, or only to play it for its score.

    A few are compared, and the episode continues from the best first; then from the next few. The caller sends the
    score of a played candidate, or why it can't be played; nothing after continuing, which has failed then.

    Args:
        candidates: of a decision, taken as they are needed.
        effort: how many are compared and continued from.
        result: of the episode so far.

    Raises:
        DeadEnd: the episode continued from some candidates, and from no other it shall.
        PlanningFailed: none can be played; of the last one.
    """
    failure, continued, left = PlanningFailed("decision", "no_candidate"), 0, iter(candidates)
    while continued < effort.tries and not result.exhausted:
        compared: list[tuple[float, T]] = []
        for candidate in left:
            outcome = yield candidate, False
            if isinstance(outcome, PlanningFailed):
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
