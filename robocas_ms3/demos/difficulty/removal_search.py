"""Smallest number of objects to remove before a target can be grasped, found by simulation in forked processes.

The search deepens iteratively: it simulates all sequences of 0, 1, 2, ... removals until one makes the target
graspable. A forked process simulates each removal, so that the scene of the calling process does not change.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.demos.forked_processes import ForkedProcessError, run_in_forked_process

SEQUENCE_TIMEOUT = 1200.0  # s of wall-clock time for a removal and all removals after it
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RemovalScene:
    """Scene whose objects can be removed; all functions act on the scene of the process that calls them.

    Attributes:
        list_obstacles: returns the slots of the objects that may be removed next, the most promising first.
        count_blockers: returns the smallest number of objects that block a grasp of the target.
        ways: number of ways to remove an object.
        remove: removes the object in a slot in a way, from 0; raises PlanningError if this is not possible.
        can_grasp: tries to grasp the target in forked processes, and returns whether it is held; raises
            ForkedProcessError if one of them crashes or exceeds its time limit.
    """

    list_obstacles: Callable[[], list[int]]
    count_blockers: Callable[[], int]
    ways: int
    remove: Callable[[int, int], None]
    can_grasp: Callable[[], bool]


@dataclass(frozen=True)
class RemovalResult:
    """Result of a search.

    Attributes:
        removals: smallest number of removals after which the target can be grasped; None: no sequence was found.
        first: slots of the objects with which a sequence of this length can start.
        simulated: number of simulated removals.
        complete: whether no limit of the simulated removals, and no crashed process, has left out a sequence. If one
            has, ``removals`` is an upper bound, and ``first`` may lack objects.
    """

    removals: int | None
    first: tuple[int, ...]
    simulated: int
    complete: bool


@dataclass(frozen=True)
class _RemovalOutcome:
    """Outcome of a removal in a forked process.

    Attributes:
        possible: whether the object was removed.
        solved: whether the target can be grasped after this and the further removals.
        simulated: number of removals that the search has simulated so far.
        complete: whether the search has simulated every sequence so far.
    """

    possible: bool
    solved: bool
    simulated: int
    complete: bool


class RemovalSearch:
    """Search for the smallest number of removals.

    A sequence is not continued if every grasp is blocked by more objects than may still be removed.

    Args:
        scene: scene of this process, which does not change.
        max_removals: largest number of removals to search.
        max_simulated: number of simulated removals after which no other sequence is started.
    """

    def __init__(self, scene: RemovalScene, max_removals: int, max_simulated: int) -> None:
        self._scene = scene
        self._max_removals, self._max_simulated = max_removals, max_simulated
        self._simulated, self._complete = 0, True  # a forked process continues with its copy

    def run(self) -> RemovalResult:
        """Search, and return the result.

        Raises:
            ForkedProcessError: the process of a grasp without removals crashed or exceeded its time limit.
        """
        if self._scene.can_grasp():
            return RemovalResult(0, (), 0, complete=True)
        for removals in range(1, self._max_removals + 1):
            first = self._find_first(removals, stop_early=False)
            if first or not self._complete:
                return RemovalResult(removals if first else None, tuple(first), self._simulated, self._complete)
        return RemovalResult(None, (), self._simulated, complete=True)

    def _find_first(self, removals: int, *, stop_early: bool) -> list[int]:
        """Return the slots with which a sequence of this many removals can start; at most one if ``stop_early``."""
        first: list[int] = []
        if self._scene.count_blockers() > removals:
            return first
        for slot in self._scene.list_obstacles():
            if self._simulated >= self._max_simulated:
                self._complete = False
                break
            outcome = self._try_removal(slot, removals - 1)
            if outcome.solved:
                first.append(slot)
                if stop_early:
                    break
        return first

    def _try_removal(self, slot: int, left: int) -> _RemovalOutcome:
        """Remove an object in the first possible way in a forked process, and search for ``left`` further removals."""
        outcome = _RemovalOutcome(False, False, self._simulated, self._complete)
        for way in range(self._scene.ways):
            try:
                outcome = run_in_forked_process(partial(self._remove, slot, way, left), SEQUENCE_TIMEOUT)
            except ForkedProcessError as error:
                _log.warning("the removal of slot %d is left out: its process %s", slot, error)
                outcome = _RemovalOutcome(False, False, self._simulated + 1, complete=False)
            self._simulated, self._complete = outcome.simulated, outcome.complete
            if outcome.possible:
                break
        return outcome

    def _remove(self, slot: int, way: int, left: int) -> _RemovalOutcome:
        """Remove an object, and search for ``left`` further removals; this changes the scene of the process."""
        try:
            self._scene.remove(slot, way)
        except PlanningError:
            return _RemovalOutcome(False, False, self._simulated, self._complete)
        self._simulated += 1
        solved = bool(self._find_first(left, stop_early=True)) if left else self._scene.can_grasp()
        return _RemovalOutcome(True, solved, self._simulated, self._complete)
