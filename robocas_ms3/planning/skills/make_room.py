"""Make room for a grasp on a free surface: move an object that is in the way."""

from __future__ import annotations

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.planning.decisions import SearchLimits
from robocas_ms3.planning.executor import OPEN
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.grasp import grasp_candidates
from robocas_ms3.planning.skills.heap import Move, execute_move, find_fallen_objects
from robocas_ms3.planning.skills.remove import find_grasp_blockers

MAX_BLOCKERS = 3  # objects that may be moved, those that block most grasps first
TURNS_DEG = (30.0, -30.0)  # offsets from the first direction of a push
MOVES_COMPARED = 2


def can_make_room(arm: Arm) -> bool:
    """Return whether `make_room` may help: the surface is free from above, the base is fixed, and it has not failed."""
    return arm.approach == "top" and not arm.executor.drives_base and not arm.executor.experience.dead_ends


def make_room(arm: Arm, slot: int) -> None:
    """Move one of the objects around the object in ``slot``, so that it has clear grasps.

    If this fails, later attempts at the seed do not try it again (`can_make_room`).

    Raises:
        PlanningError: every move fails, makes an object fall or gives no clear grasp; the error of the last move.
    """
    fallen, done = find_fallen_objects(arm), len(arm.executor.actions)

    def execute(move: Move) -> float:
        execute_move(arm, move, slot)
        if find_fallen_objects(arm) - fallen:
            raise PlanningError("clear", "fell_off_table")
        arm.rise_until_free()
        arm.executor.gripper = OPEN  # opens during the next motion
        with arm.planning_time():
            return float(len(list(grasp_candidates(arm, slot, 0))))

    with arm.planning_time():
        blockers = find_grasp_blockers(arm, slot)[:MAX_BLOCKERS]
    moves = [Move("push", blocker) for blocker in blockers] + [Move("lift", blocker) for blocker in blockers]
    moves += [Move("push", blocker, turn) for turn in TURNS_DEG for blocker in blockers]
    try:
        arm.choose(moves, execute, SearchLimits(MOVES_COMPARED), kind="move")
    except PlanningError:
        arm.executor.experience.dead_ends += len(arm.executor.actions) == done
        raise
