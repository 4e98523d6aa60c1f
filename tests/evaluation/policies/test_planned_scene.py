"""Deviations of a scene from a plan, with positions worked out by hand.

The plan has 61 states. The TCP moves from (0, 0, 0.5) to the target at (0.5, 0, 0) in the states 0 to 20, closes there,
carries the target up by 1 cm per state until state 40, and opens. Body 0 is the target, body 1 an obstacle at
(0.5, 0.3, 0), and joint 0 a drawer at 0.
"""

from __future__ import annotations

import numpy as np
import pytest

from robocas_ms3.evaluation.policies.planned_scene import PlannedGrasp, PlannedScene, SceneState, measure_speeds
from robocas_ms3.robots.registry import find_robot

STATES, GRASPED, RELEASED = 61, 20, 40
WINDOW = 4


def make_plan(pushed_between: tuple[int, int] | None = None) -> PlannedScene:
    """Return the plan; the obstacle moves by 1 cm per state in the states ``pushed_between``."""
    time = np.arange(STATES)
    tcp = np.tile(np.eye(4), (STATES, 1, 1))
    tcp[:, 0, 3] = 0.5 * np.minimum(time / GRASPED, 1)
    tcp[:, 2, 3] = np.where(time < GRASPED, 0.5 - 0.025 * time, 0.01 * (np.clip(time, GRASPED, RELEASED) - GRASPED))
    bodies = np.tile([[0.5, 0, 0], [0.5, 0.3, 0]], (STATES, 1, 1))
    bodies[GRASPED:, 0] = tcp[GRASPED:, :3, 3]
    if pushed_between:
        bodies[:, 1, 1] += 0.01 * (np.clip(time, *pushed_between) - pushed_between[0])
    closed = (time > GRASPED) & (time <= RELEASED)
    return PlannedScene(SceneState(tcp, bodies, np.zeros((STATES, 1)), np.where(closed, 0.03, 0.08)), closed)


def at(plan: PlannedScene, index: int) -> SceneState:
    """Return the planned state with this index as the present state."""
    return SceneState(**{name: values[index : index + 1].copy() for name, values in vars(plan.states).items()})


@pytest.mark.parametrize(
    ("body", "offset", "deviating"), [(0, 0.019, []), (0, 0.021, [0]), (1, 0.059, []), (1, 0.061, [1])]
)
def test_body_that_will_be_moved_may_be_2_cm_away_and_any_other_6_cm(body, offset, deviating):
    plan = make_plan()
    now = at(plan, 5)
    now.bodies[0, body, 0] += offset
    assert plan.find_deviations(now, 5, WINDOW) == deviating


def test_carried_body_may_lag_with_the_gripper_and_other_bodies_do_not_matter():
    plan = make_plan()
    now = at(plan, 32)
    now.tcp[0, :3, 3] -= 0.06  # the arm is 6 cm behind on each axis, with the target
    now.bodies[0, 0] -= 0.06
    now.bodies[0, 1] += 0.2
    assert plan.find_deviations(now, 32, WINDOW) == []
    now.bodies[0, 0, 1] += 0.05  # the target is 5 cm out of place in the gripper
    assert plan.find_deviations(now, 32, WINDOW) == [0]


def test_slipped_body_deviates():
    plan = make_plan()
    now = at(plan, 32)
    now.bodies[0, 0] = 0.5, 0, 0  # it stayed where it was; planned: 12 cm higher
    assert plan.find_deviations(now, 32, WINDOW) == [0]


def test_pushed_body_is_compared_when_it_is_at_rest():
    """The obstacle moves until state 8. The states at most 10 after that count as its motion."""
    plan = make_plan(pushed_between=(2, 8))
    for index, deviating in ((5, []), (17, []), (19, [1])):
        now = at(plan, index)
        now.bodies[0, 1, 1] += 0.07
        assert plan.find_deviations(now, index, WINDOW) == deviating, index


def test_a_carried_body_may_be_some_states_behind():
    """It is compared with the states 28 to 36: 4 states behind it agrees; 8 states behind, 4 cm are left."""
    plan = make_plan()
    for states_behind, deviating in ((4, []), (8, [0])):
        now = at(plan, 32)
        now.bodies[0, 0, 2] -= 0.01 * states_behind
        assert plan.find_deviations(now, 32, WINDOW) == deviating, states_behind


def test_nothing_is_compared_after_the_last_release():
    plan = make_plan()
    now = at(plan, 41)
    now.bodies[:] += 1.0
    assert plan.find_deviations(now, 41, WINDOW) == []


def test_grasps_are_found_by_the_body_that_moves_with_the_gripper():
    plan = make_plan(pushed_between=(22, 38))
    assert plan.list_grasps() == [PlannedGrasp(body=0, closes=GRASPED, holds=GRASPED + 1)]
    assert PlannedScene(plan.states, np.ones(STATES, bool)).list_grasps() == []  # closed from the start on
    plan.states.bodies[GRASPED:, 0] = plan.states.bodies[GRASPED, 0]  # the gripper closes on nothing
    assert plan.list_grasps() == []


@pytest.mark.parametrize(
    ("index", "weight"), [(79, 0), (80, 0), (85, 0.25), (100, 1), (103, 1), (113, 1), (123, 0.5), (133, 0), (140, 0)]
)
def test_shift_of_a_grasp_grows_in_1_s_and_fades_in_1_s_after_the_lift(index, weight):
    """1 s is 20 states; the body is held from state 103 on, and lifted until state 113."""
    assert PlannedGrasp(body=0, closes=100, holds=103).shift_weight(index) == pytest.approx(weight)


def test_furniture_joints_follow_the_bodies():
    plan = make_plan()
    now = at(plan, 5)
    now.joints[0, 0] = 0.06  # at most 0.05
    assert plan.find_deviations(now, 5, WINDOW) == [2]


@pytest.mark.parametrize(("lag", "away"), [(0.14, False), (0.16, True)])
def test_arm_may_lag_by_15_cm(lag, away):
    plan = make_plan()
    now = at(plan, 50)
    now.tcp[0, 1, 3] += lag
    assert plan.is_tcp_away(now, 50, WINDOW) == away


def test_states_are_read_in_the_order_of_the_names():
    robot = find_robot(None)
    bodies = {name: np.array([[x, 0, 0, 1, 0, 0, 0, 3, 4, 0, 0, 0, 0]], float) for name, x in (("b", 2.0), ("a", 1.0))}
    arm, drawer = np.zeros((1, 37)), np.zeros((1, 15))
    arm[0, 3] = drawer[0, 3] = 1
    arm[0, 23:25], drawer[0, 13:] = (0.01, 0.02), (0.1, 9.0)  # fingers; position and velocity of the drawer
    states = {"actors": bodies, "articulations": {robot.description.uid: arm, "drawer": drawer}}
    read = SceneState.from_states(robot, states)
    assert read.bodies[0, :, 0].tolist() == [1, 2]
    assert read.joints.tolist() == [[0.1]]
    assert read.width[0] == pytest.approx(0.03)
    assert measure_speeds(states).tolist() == [5, 5]
