"""Decisions that are undone: what is tried, in which order, and when a decision is given up.

How a moment is come back to is another matter: `branches` forks there, `resimulation` runs the attempt again from its
reset. Both play the same candidates in the same order, so that the episodes are the same.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from typing import Any, Protocol, TypeVar

from robocas_ms3.core.errors import PlanningFailed
from robocas_ms3.planning.decisions import Effort

T = TypeVar("T")


class Tally(Protocol):
    """What survives what is undone: where time went and what failed. Whoever is running has the only valid one."""

    @property
    def exhausted(self) -> bool:
        """Whether no further attempt may be made."""
        ...

    def failed(self, error: PlanningFailed) -> None:
        """Note a failed attempt."""
        ...

    def adopt(self, other: Any) -> None:
        """Become what another process sent."""
        ...


class DeadEnd(Exception):  # noqa: N818  (no error: the attempts from here have failed, and are noted already)
    """Every way from here was gone, in vain: the decision before has to be made otherwise."""


def turns(
    candidates: Iterable[T], effort: Effort, tally: Tally
) -> Generator[tuple[T, bool], float | PlanningFailed | None, None]:
    """Which candidate is due, and whether to go on from it, or only to look how well it can be played.

    A few are compared and gone on from, the best first; then the next few.

    Args:
        candidates: of a decision, taken as they are needed.
        effort: how many are compared, and gone on from.
        tally: of the episode.

    Yields:
        The candidate, and whether to go on from it. After a look its score is to be sent, or why it can't be played;
        after going on, which has failed then, nothing.

    Raises:
        DeadEnd: some were gone on from, and no other shall be.
        PlanningFailed: none can be played; of the one that came last.
    """
    failure, gone_on, left = PlanningFailed("decision", "no_candidate"), 0, iter(candidates)
    while gone_on < effort.tries and not tally.exhausted:
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
            gone_on += 1
            if gone_on == effort.tries or tally.exhausted:
                break
    raise DeadEnd if gone_on else failure
