"""Scripted policy of search: look, clear what covers and surrounds the target, grasp it, carry it to the basket.

What to move, and how, is decided by trying a few ways and taking the one after which least is left to do.
"""

from __future__ import annotations

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.planning.decisions import SearchLimits
from robocas_ms3.planning.executor import OPEN
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.grasp import grasp
from robocas_ms3.planning.skills.heap import COUNTERS, Heap
from robocas_ms3.planning.skills.look import FAR, NEAR, load_object_meshes, look_at
from robocas_ms3.planning.skills.place import carry_to_basket, release_into_basket
from robocas_ms3.planning.skills.remove import raise_held_object

LIFT_HEIGHT = 0.15  # m, upstream's
AHEAD = 3  # moves that are compared
ENOUGH = -18.0  # s; a move after which nothing is left to do, and which took no longer, is not compared with others
GRASPS = 3  # kinds of grasps of the target that are tried


def attempt(arm: Arm) -> None:
    slot, heap = arm.target, Heap(arm, arm.target)
    for fact in COUNTERS:
        arm.executor.facts.setdefault(fact, 0)
    with arm.planning_time():
        load_object_meshes(arm)
    arm.start_subgoal("find the object")
    look_at(arm, heap.centroid(slot), FAR)
    while True:
        if heap.target_cleared:
            arm.start_subgoal("move and grasp")
            if _grasp(arm, slot):
                break
            arm.start_subgoal("find the object")
        done = len(arm.executor.actions)
        try:
            arm.choose(heap.candidate_moves(), heap.execute, SearchLimits(AHEAD, tries(heap.moves_made), ENOUGH))
        except PlanningError:
            if len(arm.executor.actions) > done:
                raise
            # nothing can be moved: perhaps it can be grasped as things stand
            arm.start_subgoal("move and grasp")
            if not heap.target_visible or not _grasp(arm, slot):
                raise
            break
        arm.executor.check_open_loop()
        if heap.target_uncovered and not heap.target_visible:
            look_at(arm, heap.centroid(slot), NEAR)
    arm.executor.check_open_loop()
    arm.start_subgoal("transfer object")
    carry_to_basket(arm, slot)
    heap.check_objects_on_surface()
    release_into_basket(arm, slot)


def tries(moves_made: int) -> int:
    """Return how many moves to continue from: fewer after more moves, whose failures tend to lie further back."""
    return max(1, 3 - moves_made // 2)


def _grasp(arm: Arm, slot: int) -> bool:
    """Grasp the target and lift it; False where it can't be done, with nothing moved."""
    done = len(arm.executor.actions)

    def play(kind: int) -> float:
        arm.executor.gripper = OPEN  # it opens on the way
        grasp(arm, slot, lift_height=LIFT_HEIGHT, skip_kinds=kind)
        raise_held_object(arm, slot)
        return 0.0

    try:
        arm.choose(range(GRASPS), play)
    except PlanningError:
        if len(arm.executor.actions) > done:
            raise
        return False
    return True
