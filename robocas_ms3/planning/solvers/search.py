"""Scripted policy of search: look, clear obstacles, grasp the target, carry it to the basket.

The policy runs several candidate moves and continues from the move with the lowest cost.
"""

from __future__ import annotations

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.planning.decisions import WITH_NOISE, SearchLimits
from robocas_ms3.planning.executor import OPEN
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.grasp import grasp, grasp_candidates, retract_from_contact
from robocas_ms3.planning.skills.heap import COUNTERS, Heap, Move, find_fallen_objects
from robocas_ms3.planning.skills.look import FAR, NEAR, load_object_meshes, look_at
from robocas_ms3.planning.skills.place import carry_to_basket, release_into_basket
from robocas_ms3.planning.skills.remove import find_grasp_blockers, raise_held_object

LIFT_HEIGHT = 0.15  # m (RoboCAS-v0)
MOVES_COMPARED = 3  # candidate moves that are compared
SUFFICIENT_SCORE = -15.0  # s; a move with this score is not compared with others: no work left and at most 15 s
SUFFICIENT_GAIN = 8.0  # s; neither is a move that saves this much
GRASP_KINDS = 3  # kinds of grasps of the target to try
MAX_TOUCHED_OBJECTS = 3  # objects for which a grasp is tried that may touch this object


def attempt(arm: Arm) -> None:
    """Make one attempt at search from the present state; raise PlanningError if it fails."""
    slot, heap = arm.target, Heap(arm, arm.target, find_fallen_objects(arm) - {arm.target})
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
            sufficient = min(SUFFICIENT_SCORE, SUFFICIENT_GAIN - heap.remaining_cost())
            limits = SearchLimits(MOVES_COMPARED, max_continued_moves(heap.moves_made), sufficient)
            move = arm.choose(heap.candidate_moves(), heap.execute, limits, kind="move")
        except PlanningError:
            if len(arm.executor.actions) > done:
                raise
            # no move is feasible: try to grasp the target now
            if heap.target_exposed and not heap.target_visible:
                look_at(arm, heap.centroid(slot), NEAR)
            arm.start_subgoal("move and grasp")
            if not heap.target_visible or not _grasp(arm, slot):
                arm.executor.experience.dead_ends += 1
                raise
            break
        _check_move(arm, move)
        if heap.target_uncovered and not heap.target_visible:
            look_at(arm, heap.centroid(slot), NEAR)
    arm.executor.check_open_loop()
    arm.start_subgoal("transfer object")
    arm.run_first_candidate("release", lambda: _carry_and_release(arm, heap))


def _carry_and_release(arm: Arm, heap: Heap) -> None:
    carry_to_basket(arm, heap.target)
    heap.check_objects_on_surface()
    release_into_basket(arm, heap.target)


def max_continued_moves(moves_made: int) -> int:
    """Return the number of candidate moves to continue from before the search backtracks.

    The number decreases with the moves made, since later failures have earlier causes.
    """
    return max(1, 3 - moves_made // 2)


def _check_move(arm: Arm, move: Move) -> None:
    """Check the actions open loop; if the check fails without noise, later decisions of the seed avoid such moves."""
    try:
        arm.executor.check_open_loop()
    except PlanningError as error:
        arm.executor.experience.failed_checks[move.skill, move.slot] += not error.reason.endswith(WITH_NOISE)
        raise


def _grasp(arm: Arm, slot: int) -> bool:
    """Grasp the target and lift it; return False if no grasp is feasible and the arm has not moved.

    The last grasps are those in which the gripper touches and moves one of the other objects.
    """
    done = len(arm.executor.actions)

    def execute_grasp(option: tuple[int, tuple[int, ...]]) -> float:
        grasp_in_clutter(arm, slot, *option)
        return 0.0

    with arm.planning_time():
        blockers = find_grasp_blockers(arm, slot)[:MAX_TOUCHED_OBJECTS]
    options = [(kind, ()) for kind in range(GRASP_KINDS)] + [(0, (blocker,)) for blocker in blockers]
    try:
        arm.choose(options, execute_grasp, kind="grasp")
    except PlanningError:
        if len(arm.executor.actions) > done:
            raise
        return False
    return True


def grasp_in_clutter(arm: Arm, slot: int, kind: int, movable: tuple[int, ...] = ()) -> None:
    """Grasp an object between other objects with a grasp of a kind, and lift it.

    Args:
        arm: context of the attempt.
        slot: slot of the object.
        kind: kind of grasp, from 0 for the best one.
        movable: slots of other objects that the gripper may touch and move.

    Raises:
        PlanningError: no grasp can be planned, the fingers miss the object, or the object slips out.
    """
    arm.rise_until_free()  # an object may lean on the tool after a push
    arm.executor.gripper = OPEN  # opens during the approach
    with arm.planning_time():
        candidates = grasp_candidates(arm, slot, kind, movable)
        grasps = retract_from_contact(arm, slot, candidates, movable)
    if not grasps:
        raise PlanningError("grasp_sampling", "arm_in_contact")
    grasp(arm, slot, lift_height=LIFT_HEIGHT, grasps=grasps, movable=movable)
    raise_held_object(arm, slot)
