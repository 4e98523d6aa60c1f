"""Object that the scripted policy of search would move first in a scene."""

from __future__ import annotations

from functools import partial

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.demos.forked_processes import ForkedProcessError, run_in_forked_process
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.heap import COUNTERS, Heap, find_fallen_objects
from robocas_ms3.planning.solvers.search import MOVES_COMPARED
from robocas_ms3.tasks.search import RoboCASSearchEnv


def choose_scripted_removal(arm: Arm) -> int | None:
    """Return the slot of the object in the cheapest of the first feasible moves of the scripted policy of search.

    Like the policy, the function simulates candidate moves in their order until three were feasible. It simulates them
    from the present state of the arm, in forked processes. The policy may compare fewer moves, and first moves the
    gripper camera to the target, so its own choice may differ. The result is None if no move is feasible, and for other
    tasks.
    """
    if not isinstance(arm.env, RoboCASSearchEnv):
        return None
    for fact in COUNTERS:
        arm.executor.facts.setdefault(fact, 0)
    heap = Heap(arm, arm.target, find_fallen_objects(arm) - {arm.target})
    scores: list[tuple[float, int]] = []
    for move in heap.candidate_moves():
        try:
            scores.append((run_in_forked_process(partial(heap.execute, move)), move.slot))
        except (PlanningError, ForkedProcessError):
            continue
        if len(scores) == MOVES_COMPARED:
            break
    return max(scores)[1] if scores else None
