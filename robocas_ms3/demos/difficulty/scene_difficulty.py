"""Difficulty of a scene: how visible and accessible its target is, and how many objects have to be removed first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.demos.candidates.measure import measure_clutter
from robocas_ms3.demos.candidates.recorder import SETTLE_SECONDS
from robocas_ms3.demos.difficulty.records import RemovalLimits, SceneDifficulty
from robocas_ms3.demos.difficulty.removal_search import RemovalScene, RemovalSearch
from robocas_ms3.demos.difficulty.scripted_choice import choose_scripted_removal
from robocas_ms3.demos.forked_processes import run_in_forked_process
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.planning.decisions import IrreversibleDecisions
from robocas_ms3.planning.executor import MotionExecutor
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.grasp import NO_CANDIDATES
from robocas_ms3.planning.skills.heap import Move, execute_move, find_fallen_objects
from robocas_ms3.planning.skills.remove import count_clear_grasps, count_fewest_blockers, find_grasp_blockers
from robocas_ms3.planning.solvers.search import GRASP_KINDS, grasp_in_clutter

MAX_OBSTACLES = 6  # objects that may be removed next, those that block most grasps first
PUSH_TURNS_DEG = (0.0, 30.0, -30.0)  # rotations of a push from the paper's direction (`Move`)
NEIGHBOURS = 3  # nearest objects whose gaps are measured
MAX_GAP = 0.2  # m


def measure_difficulty(generator: EpisodeGenerator, seed: int, limits: RemovalLimits) -> SceneDifficulty:
    """Measure the difficulty of the scene of a seed.

    The search simulates each removal, and the grasp of the target after it, with the skills of the scripted policy: an
    object is lifted and placed elsewhere; if this is not possible, it is pushed away from the target.

    Args:
        generator: generator of the task and configuration, whose process can be forked. Objects are grasped from above,
            and the base does not drive.
        seed: seed of the scene.
        limits: limits of the search.

    Raises:
        LayoutError: the seed has no layout.
        ForkedProcessError: the process of a grasp crashed or exceeded its time limit.
    """
    executor = MotionExecutor(generator.env, seed)
    executor.reset()
    arm = Arm(
        generator.planner,
        generator.inverse_kinematics,
        executor,
        IrreversibleDecisions(lambda: len(executor.actions)),
    )
    target, present = arm.target, arm.env.present[0].cpu().numpy()
    hidden, obstacles = measure_clutter(arm)
    others = [slot for slot in np.flatnonzero(present).tolist() if slot != target]
    result = RemovalSearch(
        make_removal_scene(arm, limits.grasp_attempts), limits.max_removals, limits.max_simulated
    ).run()
    return SceneDifficulty(
        seed=seed,
        target=arm.env.target_asset().asset.id,
        objects=int(present.sum()),
        visible_fraction=round(1 - float(hidden[target]), 4),
        obstacles=int(obstacles[target].sum()),
        free_grasps=count_clear_grasps(arm, target),
        fewest_blockers=count_fewest_blockers(arm, target),
        gap=round(measure_gap(arm.scene.object_points(target), [arm.scene.object_points(slot) for slot in others]), 4),
        removals=result.removals,
        first_removals=sorted(result.first),
        scripted_removal=choose_scripted_removal(arm) if result.first else None,
        simulated_removals=result.simulated,
        complete=result.complete,
    )


def measure_gap(target: NDArray[np.floating], others: Sequence[NDArray[np.floating]]) -> float:
    """Return the mean distance between an object and its `NEIGHBOURS` nearest objects, at most `MAX_GAP` each, m.

    Args:
        target: (P, 3) surface points of the object, m.
        others: surface points (Q, 3) of each other object, m.
    """
    tree = KDTree(target)
    gaps = [float(tree.query(points)[0].min()) for points in others] + [MAX_GAP] * NEIGHBOURS
    return float(np.minimum(sorted(gaps)[:NEIGHBOURS], MAX_GAP).mean())


def make_removal_scene(arm: Arm, grasp_attempts: int) -> RemovalScene:
    """Make the scene of a search with the skills of the scripted policy, in the present state of the arm."""
    target = arm.target

    def list_obstacles() -> list[int]:
        blockers = find_grasp_blockers(arm, target)
        obstacles = np.flatnonzero(measure_clutter(arm)[1][target]).tolist()
        return list(dict.fromkeys([*blockers, *obstacles]))[:MAX_OBSTACLES]

    def remove(slot: int, way: int) -> None:
        fallen = find_fallen_objects(arm)
        arm.follow_path((*arm.decision_path, slot, way))
        move = Move("push", slot, PUSH_TURNS_DEG[way - 1]) if way else Move("lift", slot)
        execute_move(arm, move, target)
        arm.executor.move_gripper(arm.executor.gripper, arm.qpos, seconds=SETTLE_SECONDS)
        if find_fallen_objects(arm) - fallen:
            raise PlanningError("clear", "fell_off_table")

    def grasp(attempt: int, kind: int) -> None:
        arm.follow_path((*arm.decision_path, attempt))  # other random numbers
        grasp_in_clutter(arm, target, kind)

    def can_grasp() -> bool:
        for attempt, kind in product(range(grasp_attempts), range(GRASP_KINDS)):
            reason = _try_in_fork(partial(grasp, attempt, kind))
            if not reason:
                return True
            if kind == 0 and reason in NO_CANDIDATES:
                break  # another attempt has no candidates either
        return False

    return RemovalScene(
        list_obstacles, partial(count_fewest_blockers, arm, target), 1 + len(PUSH_TURNS_DEG), remove, can_grasp
    )


def _try_in_fork(skill: Callable[[], None]) -> str:
    """Run a skill in a forked process, and return why it failed, or an empty text; this process does not change."""

    def run() -> str:
        try:
            skill()
        except PlanningError as error:
            return error.reason
        return ""

    return run_in_forked_process(run)
