"""Make room for a grasp on a free surface: move an object that is in the way."""

from __future__ import annotations

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.planning.decisions import SearchLimits
from robocas_ms3.planning.executor import OPEN
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.heap import Move, execute_move
from robocas_ms3.planning.skills.remove import count_feasible_grasps, find_grasp_blockers

MAX_BLOCKERS = 3  # objects that may be moved, those that block most grasps first
TURNS_DEG = (30.0, -30.0)  # offsets from the first direction of a push
MOVES_COMPARED = 2


def can_make_room(arm: Arm) -> bool:
    """Return whether objects can be moved: they stand on a surface that is free from above, and the base stays."""
    return arm.approach == "top" and not arm.executor.drives_base


def make_room(arm: Arm, slot: int) -> None:
    """Move one of the objects around the object in ``slot``, so that it has a feasible grasp.

    Raises:
        PlanningError: no move is possible, or none gives a feasible grasp (reason ``no_progress``).
    """

    def execute(move: Move) -> float:
        execute_move(arm, move, slot)
        arm.rise_until_free()
        arm.executor.gripper = OPEN  # opens during the next motion
        with arm.planning_time():
            grasps = count_feasible_grasps(arm, slot)
        if not grasps:
            raise PlanningError("clear", "no_progress")
        return float(grasps)

    with arm.planning_time():
        blockers = find_grasp_blockers(arm, slot)[:MAX_BLOCKERS]
    moves = [Move("push", blocker) for blocker in blockers] + [Move("lift", blocker) for blocker in blockers]
    moves += [Move("push", blocker, turn) for turn in TURNS_DEG for blocker in blockers]
    arm.choose(moves, execute, SearchLimits(MOVES_COMPARED), kind="move")
    arm.executor.check_open_loop()
