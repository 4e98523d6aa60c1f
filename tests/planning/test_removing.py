"""Simulated moves in a heap: removed objects are placed elsewhere, pushes move objects away from the target."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from mani_skill.utils.structs import Pose

from robocas_ms3.core.errors import PlanningError, UnrecoverableError
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.planning.decisions import IrreversibleDecisions
from robocas_ms3.planning.executor import MotionExecutor
from robocas_ms3.planning.protocol import Obstacle, Shape
from robocas_ms3.planning.pushes import compute_push_direction
from robocas_ms3.planning.skills import grasp as grasp_skill
from robocas_ms3.planning.skills import heap as heap_skill
from robocas_ms3.planning.skills import push
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.grasp import NO_CANDIDATES, grasp_candidates, retract_from_contact
from robocas_ms3.planning.skills.heap import Heap, Move, find_fallen_objects
from robocas_ms3.planning.skills.push import push_away
from robocas_ms3.planning.skills.remove import count_clear_grasps, find_grasp_blockers, remove_object
from robocas_ms3.planning.solvers import search
from robocas_ms3.scenes.grasp_checks import NEIGHBOURHOOD

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def generator():
    made = EpisodeGenerator(EpisodeSettings("search", "search_table_small_heap", "builtin"))
    yield made
    made.close()


def start_episode(generator, seed):
    """Return the arm at the start of an episode and the other objects of the heap, the highest first."""
    executor = MotionExecutor(generator.env, seed)
    executor.reset()
    executor.facts = {"pushes": 0, "removals": 0}
    arm = Arm(
        generator.planner, generator.inverse_kinematics, executor, IrreversibleDecisions(lambda: len(executor.actions))
    )
    target = int(arm.env.target_slot[0])
    slots = [s for s in np.flatnonzero(arm.env.present[0].numpy()).tolist() if s != target]
    return arm, target, sorted(slots, key=lambda slot: -surface(arm, slot)[:, 2].max())


def surface(arm, slot):
    return arm.scene.object_points(slot)


def first_that_works(skill, slots):
    """Run the first feasible move, since feasibility depends on the plans that are found."""
    for slot in slots:
        try:
            skill(slot)
        except PlanningError:
            continue
        return slot
    return None


def test_removed_object_is_upright_at_a_free_position_of_the_table(generator, monkeypatch):
    arm, target, slots = start_episode(generator, 13)  # a bottle leans on what is under it
    before = {slot: surface(arm, slot) for slot in [*slots, target]}
    moved, turns = slots[0], []
    follow = arm.follow

    def followed(*motions):
        follow(*motions)
        turns.append(arm.scene.object_in_base(moved)[:3, :3])

    monkeypatch.setattr(arm, "follow", followed)
    remove_object(arm, moved)
    let_go, left = turns[-2:]
    leant = np.degrees(np.arccos(let_go[2] @ left[2]))  # between the object's upright axis then and now
    assert leant < 3  # as it was put down it stays
    after = surface(arm, moved)
    table = min(points[:, 2].min() for points in before.values())
    assert after[:, 2].min() == pytest.approx(table, abs=0.005)  # it is on the table
    assert np.linalg.norm((after - before[moved]).mean(axis=0)[:2]) > 0.05
    others = np.concatenate([surface(arm, slot) for slot in before if slot != moved])
    gaps = np.linalg.norm(after[:, None, :2] - others[None, ::10, :2], axis=2)
    assert gaps.min() > 0.02  # clear of all others, seen from above
    assert not arm.env.is_object_grasped().any()
    assert float(arm.env.agent.gripper_width[0]) > 0.07


def test_push_moves_an_object_away_from_the_target(generator):
    arm, target, slots = start_episode(generator, 4)
    starts = {slot: surface(arm, slot).mean(axis=0) for slot in [*slots, target]}
    pushed = first_that_works(lambda slot: push_away(arm, slot, target), slots)
    assert pushed is not None
    ahead = compute_push_direction(np.random.default_rng(0), starts[pushed], starts[target])
    shift = surface(arm, pushed).mean(axis=0) - starts[pushed]
    assert shift @ ahead > 0.02
    assert np.abs(arm.env.gripper_forces()).max() == 0  # it has let go of everything


def test_push_without_displacement_fails(generator, monkeypatch):
    arm, target, slots = start_episode(generator, 3)
    heap, facts = Heap(arm, target), arm.executor.facts
    pushed = arm.env.objects[slots[0]]

    def push(by):
        def move(arm, slot, target, *, turn_deg):
            assert turn_deg == 30
            pushed.set_pose(Pose.create_from_pq(pushed.pose.p + torch.tensor([[by, 0.0, 0.0]]), pushed.pose.q))

        monkeypatch.setattr(heap_skill, "push_away", move)
        heap.execute(Move("push", slots[0], 30))

    with pytest.raises(PlanningError, match="not_moved"):
        push(0.015)
    assert facts == {"pushes": 0, "removals": 0}
    push(0.025)
    assert facts == {"pushes": 1, "removals": 0}
    facts["removals"] = heap_skill.MAX_MOVES - 1
    with pytest.raises(UnrecoverableError, match="too_many_obstacles"):
        heap.candidate_moves()


def test_candidate_moves_start_with_pushes_of_the_highest_and_queries_have_no_side_effect(generator):
    arm, target, _ = start_episode(generator, 3)
    state = arm.rng.bit_generator.state
    seen = [(count_clear_grasps(arm, target), find_grasp_blockers(arm, target)) for _ in range(2)]
    assert seen[0] == seen[1]
    assert arm.rng.bit_generator.state == state
    heap = Heap(arm, target)
    moves = heap.candidate_moves()
    assert target not in {move.slot for move in moves}
    assert len(set(moves)) == len(moves)
    in_the_way = np.flatnonzero(heap.env.measure_clutter().obstacles[0].numpy()).tolist()
    if in_the_way:
        assert moves[0] == Move("push", max(in_the_way, key=lambda slot: surface(arm, slot)[:, 2].max()))
    arm.executor.experience.failed_checks["push", moves[0].slot] = 1
    failed = [move for move in moves if (move.skill, move.slot) == ("push", moves[0].slot)]
    moves = [move for move in moves if move not in failed] + failed
    assert heap.candidate_moves() == moves
    infeasible, useless, useful = moves[:3]
    arm.executor.experience.gains = {infeasible: -np.inf, useless: -10.0, useful: 5.0}
    rest = [move for move in moves if move not in {infeasible, useless, *failed}]
    assert heap.candidate_moves() == [*rest, infeasible, *failed]


def test_grasps_that_touch_the_table_are_shifted_back(generator):
    arm, target, _ = start_episode(generator, 3)
    table, middle = push.read_surface(arm)[0][2, 3], surface(arm, target).mean(axis=0)
    grasps = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (3, 1, 1))  # straight down
    grasps[:, :2, 3] = middle[:2] - [0.2, 0.0]  # next to the heap
    grasps[:, 2, 3] = table + np.array([0.03, 0.006, -0.02])
    free, shifted = retract_from_contact(arm, target, grasps)  # no shift frees the third one
    assert free == pytest.approx(grasps[0])
    assert shifted[2, 3] - grasps[1, 2, 3] == pytest.approx(0.008)


def test_move_without_progress_fails_until_the_first_dead_end(generator, monkeypatch):
    arm, target, slots = start_episode(generator, 3)
    heap = Heap(arm, target)
    monkeypatch.setattr(heap_skill, "execute_move", lambda *_: None)
    monkeypatch.setattr(Heap, "target_exposed", True)
    monkeypatch.setattr(Heap, "remaining_cost", lambda _: 18.0)
    with pytest.raises(PlanningError, match="no_progress"):
        heap.execute(Move("lift", slots[0]))
    arm.executor.experience.dead_ends = 1
    assert heap.execute(Move("lift", slots[0])) == pytest.approx(-18.0)  # only the remaining work counts


def test_grasps_may_touch_movable_objects(generator, monkeypatch):
    arm, target, slots = start_episode(generator, 3)
    obstacles = []

    def record(tcp, order, points):
        obstacles.append(points)
        return iter(order.tolist())

    monkeypatch.setattr(grasp_skill, "_filter_clear", record)
    for movable in ((), slots[:1], slots):
        assert list(grasp_candidates(arm, target, 0, movable))
    around = arm.scene.object_in_base(target)[:3, 3]
    for points, excluded in zip(obstacles, ([target], [target, slots[0]], [target, *slots]), strict=True):
        expected = arm.scene.points_in_base(exclude=excluded, radius=NEIGHBOURHOOD, around=around)
        assert points == pytest.approx(expected)
    assert len(obstacles[0]) > len(obstacles[1]) > len(obstacles[2]) > 0  # the table remains


def test_whether_there_are_candidates_does_not_depend_on_random_numbers(generator):
    reasons = []
    for seed in range(985600, 985608):
        arm, target, _ = start_episode(generator, seed)
        found = set()
        for attempt in range(3):
            arm.follow_path((attempt,))
            try:
                next(grasp_candidates(arm, target, 0))
                found.add("")
            except PlanningError as error:
                found.add(error.reason)
        reasons += found
        assert len(found) == 1
    assert "" in reasons
    assert NO_CANDIDATES.intersection(reasons)


def test_grasps_without_space_are_shifted_back(generator, monkeypatch):
    arm, target, _ = start_episode(generator, 3)
    found = {tuple(pose[:3, 3].round(6)) for pose in grasp_candidates(arm, target, 0)}
    tried = []

    def clear_on_the_second_call(tcp, order, points):
        tried.append(tcp)
        return iter(order.tolist() if len(tried) == 2 else [])

    monkeypatch.setattr(grasp_skill, "_filter_clear", clear_on_the_second_call)
    shifted = next(grasp_candidates(arm, target, 0))
    assert len(tried) == 2
    assert np.linalg.norm(tried[1] - tried[0], axis=(1, 2)) == pytest.approx(0.004)  # the smallest shift
    assert tuple(shifted[:3, 3].round(6)) not in found


def test_target_is_grasped_if_no_move_is_feasible(generator, monkeypatch):
    arm, *_ = start_episode(generator, 3)
    skills = []

    def refuse(*_):
        raise PlanningError("push", "no_free_push")

    monkeypatch.setattr(Heap, "execute", refuse)
    monkeypatch.setattr(Heap, "target_visible", True)
    monkeypatch.setattr(search, "retract_from_contact", lambda *_: [np.eye(4)])
    for name in ("grasp", "raise_held_object", "carry_to_basket", "release_into_basket"):
        monkeypatch.setattr(search, name, lambda *_, name=name, **how: skills.append(name))
    search.attempt(arm)
    assert skills == ["grasp", "raise_held_object", "carry_to_basket", "release_into_basket"]


def test_arm_rises_clear_of_furniture_and_basket_after_a_push(generator, monkeypatch):
    arm, target, slots = start_episode(generator, 3)
    pushed = first_that_works(lambda slot: push.plan_push(arm, slot, target), slots)
    assert pushed is not None
    fixed, width = push._fixed_bodies, arm.planner.finger_width
    corners = np.array(list(itertools.product((0.2, 1.2), (-0.5, 0.5), (-0.005, 0.005))))

    def board_at(height):  # in the arm's base frame
        pose = np.eye(4)
        pose[2, 3] = height
        board = Obstacle("board", Shape((corners,)), pose)
        monkeypatch.setattr(push, "_fixed_bodies", lambda arm: [*fixed(arm), board])

    board_at(push.read_surface(arm)[0][2, 3] + 0.3)  # across hand or wrist
    with pytest.raises(PlanningError, match="push"):
        push.plan_push(arm, pushed, target)
    board_at(arm.scene.tcp_in_base[2, 3] + 0.12)
    with pytest.raises(PlanningError, match="push"):  # where a push was cut short
        push._plan_lift(arm, np.array([1.0, 0, 0]))
    assert arm.planner.finger_width == width
    monkeypatch.setattr(push, "_fixed_bodies", fixed)
    push._plan_lift(arm, np.array([1.0, 0, 0]))


@pytest.mark.parametrize("which", ["target", "another"])
def test_object_on_the_floor_ends_the_attempt(generator, which):
    arm, target, slots = start_episode(generator, 3)
    Heap(arm, target).check_objects_on_surface()
    fallen = arm.env.objects[target if which == "target" else slots[0]]
    fallen.set_pose(Pose.create_from_pq(torch.tensor([[-1.0, -1.0, 0.1]]), fallen.pose.q))
    with pytest.raises(UnrecoverableError, match="fell_off_table"):
        Heap(arm, target).check_objects_on_surface()
    assert find_fallen_objects(arm) == {target if which == "target" else slots[0]}
    Heap(arm, target, find_fallen_objects(arm)).check_objects_on_surface()  # as after another policy
