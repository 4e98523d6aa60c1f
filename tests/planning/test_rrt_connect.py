"""The complete planner: collision-free and exactly timed trajectories, and reasons of failures."""

from __future__ import annotations

import numpy as np
import pytest
from planning_scenes import REST, Box, cloud, corners, pose_error, table_scene, top_down

from robocas_ms3.core.errors import ExtensionError, PlanningError
from robocas_ms3.planning import rrt_connect
from robocas_ms3.planning.kinematics import ArmChain
from robocas_ms3.planning.protocol import AttachedBody, Planner, Trajectory
from robocas_ms3.planning.rrt_connect import TCP_SPEED_LIMIT
from robocas_ms3.planning.rrt_connect import make_planner as make_planner_of
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.registry import PANDA

WALL = Box((0.55, 0.0, 0.15), (0.4, 0.03, 0.4))


def reason_of(call, *args, **kwargs) -> str:
    with pytest.raises(PlanningError) as caught:
        call(*args, stage="here", **kwargs)
    assert caught.value.stage == "here"
    return caught.value.reason


def check_limits(start, trajectory, velocity=0.5, acceleration=0.5):
    rows = np.vstack([start, start, trajectory.qpos, trajectory.qpos[-1]])
    speeds = np.diff(rows, axis=0) / trajectory.dt
    assert np.abs(speeds).max() <= velocity + 1e-3
    assert np.abs(np.diff(speeds, axis=0) / trajectory.dt).max() <= acceleration * 1.05


@pytest.mark.parametrize("seed", range(3))
def test_trajectories_are_collision_free(make_planner, checker, seed):
    planner, rng = make_planner(dt=0.01), np.random.default_rng(seed)
    planner.seed(seed)
    planner.set_scene(cloud([*table_scene(seed), WALL]))
    here, planned, straight = REST, 0, 0
    for side in (1, -1, 1, -1):
        goal = top_down(rng.uniform(0.4, 0.6), side * rng.uniform(0.12, 0.3), rng.uniform(0.1, 0.2), rng.uniform(-1, 1))
        try:
            trajectory = planner.plan_to_pose(here, goal, stage="reach")
        except PlanningError as error:
            assert error.reason in ("goal_in_collision", "no_ik")
            continue
        planned += 1
        check_limits(here, trajectory)
        assert planner.is_free(trajectory.qpos).all()
        here = trajectory.qpos[-1]
        distance, angle = pose_error(checker.link_pose("panda_hand_tcp", here), goal)
        assert distance < 2e-4 and angle < 2e-3
        try:
            down = planner.plan_straight(here, goal @ shifted(0.06), stage="approach")
        except PlanningError as error:
            assert error.reason in ("straight_line_blocked", "line_unreachable", "line_joint_jump")
            continue
        straight += 1
        check_limits(here, down)
        assert planner.is_free(down.qpos).all()
    assert planned >= 2
    assert straight >= 1


def shifted(z):
    pose = np.eye(4)
    pose[2, 3] = z
    return pose


@pytest.mark.parametrize("held", [None, AttachedBody(corners(0.03, 0.03, 0.1), np.eye(4))])
def test_path_avoids_a_wall_with_a_held_object(planner, held):
    planner.seed(0)
    planner.set_scene(cloud([WALL]))
    planner.attach(held)
    start = planner.ik(top_down(0.5, 0.25, 0.2), REST)[0]
    goal = planner.ik(top_down(0.5, -0.25, 0.2), start)[0]
    trajectory = planner.plan_to_qpos(start, [goal], stage="x")
    check_limits(start, trajectory)
    np.testing.assert_array_equal(trajectory.qpos[-1], goal)
    assert planner.is_free(trajectory.qpos).all()
    assert not planner.is_free(np.linspace(start, goal, 50)).all()


@pytest.mark.parametrize("dt", [0.05, 0.2])
def test_short_motions_end_exactly_at_their_goals(make_planner, dt):
    planner = make_planner(dt=dt)
    still = planner.plan_to_qpos(REST, [REST.copy()], stage="x")
    np.testing.assert_array_equal(still.qpos, [REST])
    for size in (1e-5, 1e-3, 0.03):
        goal = REST + size
        trajectory = planner.plan_to_qpos(REST, [goal], stage="x")
        np.testing.assert_array_equal(trajectory.qpos[-1], goal)
        assert trajectory.dt == dt
        check_limits(REST, trajectory)
    here = planner.tcp(REST)
    assert len(planner.plan_straight(REST, here, stage="x").qpos) == 1
    tiny = planner.plan_straight(REST, here @ shifted(0.002), stage="x")
    assert pose_error(planner.tcp(tiny.qpos[-1]), here @ shifted(0.002))[0] < 1e-5


def test_planner_uses_the_nearest_reachable_goal(planner):
    near, far = REST + 0.2, REST + np.array([-1.0, 0.3, 0, 0, 0, 0.3, 0])
    trajectory = planner.plan_to_qpos(REST, [far, near], stage="x")
    np.testing.assert_array_equal(trajectory.qpos[-1], near)
    blocked = Box(tuple(planner.tcp(near)[:3, 3]), (0.09, 0.09, 0.03))  # wider than the open gripper
    planner.set_scene(cloud([blocked]))
    trajectory = planner.plan_to_qpos(REST, [far, near], stage="x")
    np.testing.assert_array_equal(trajectory.qpos[-1], far)


def reach_and_down(planner):
    """Return a motion to above a position on an empty table, and a line 10 cm straight down."""
    planner.set_scene([])
    goal = top_down(0.5, 0.2, 0.3)
    reach = planner.plan_to_pose(REST, goal, stage="reach")
    lower = goal.copy()
    lower[2, 3] -= 0.1
    return reach, planner.plan_straight(reach.qpos[-1], lower, stage="approach")


def test_joined_motions_do_not_stop_and_end_like_the_second(planner):
    reach, down = reach_and_down(planner)
    joined = planner.join(REST, reach, down)
    saved = reach.duration + down.duration - joined.duration
    assert 0.5 <= saved <= 1.0
    assert joined.qpos[-1].tolist() == down.qpos[-1].tolist()
    rows = np.concatenate([[REST], joined.qpos])
    speed = np.diff(rows, axis=0) / joined.dt
    assert np.abs(speed).max() <= 0.5 and np.abs(np.diff(speed, axis=0) / joined.dt).max() <= 0.5
    assert np.abs(speed[1:-1]).max(axis=1).min() > 0.02  # nowhere at rest in between
    # the last 5 cm go straight down, as planned
    low = np.array([planner.tcp(qpos)[:3, 3] for qpos in joined.qpos])
    low = low[low[:, 2] < 0.25]
    assert len(low) > 3 and np.abs(low[:, :2] - (0.5, 0.2)).max() < 0.004


def test_motions_are_joined_only_without_collisions(planner):
    reach, down = reach_and_down(planner)
    early = reach.qpos[len(reach.qpos) // 3]
    place = planner.tcp(early)[:3, 3]
    assert np.linalg.norm(place - planner.tcp(reach.qpos[-1])[:3, 3]) > 0.1  # far from the corner
    planner.set_scene(cloud([Box(tuple(place), (0.09, 0.09, 0.03))]))  # wider than the open gripper
    assert planner.find_collisions(early) and not planner.find_collisions(reach.qpos[-1])
    assert planner.join(REST, reach, down).qpos.tolist() == [*reach.qpos.tolist(), *down.qpos.tolist()]


def test_joined_motions_stay_within_joint_limits(planner, panda_files):
    planner.set_scene([])
    limit = ArmChain(panda_files.arm_urdf, MOBILE_PANDA).limits[
        5, 0
    ]  # of joint 6; both motions keep to it, their sum would not
    start, rise, fall = REST.copy(), np.tile(REST, (20, 1)), np.tile(REST, (20, 1))
    start[5], rise[:, 5], fall[:, 5] = limit + 0.02, np.linspace(limit + 0.024, limit + 0.1, 20), limit + 0.02
    first, second = Trajectory(rise, 0.05), Trajectory(fall, 0.05)
    assert planner.join(start, first, second).qpos.tolist() == [*rise.tolist(), *fall.tolist()]


def test_planner_is_created_by_name():
    typed = make_planner_of("rrt_connect", PANDA, dt=0.1)
    assert all(hasattr(typed, member) for member in vars(Planner) if not member.startswith("_"))
    assert typed.plan_to_qpos(REST, [REST + 0.2], stage="x").dt == 0.1
    with pytest.raises(ExtensionError) as caught:
        make_planner_of("ompl", PANDA, dt=0.1)
    assert caught.value.found == "'ompl'"


def test_failures_have_reasons(make_planner, monkeypatch):
    planner = make_planner()
    assert reason_of(planner.plan_to_pose, REST, top_down(1.3, 0, 0.3)) == "no_ik"
    planner.set_scene(cloud([Box((0.5, 0, 0.2), (0.1, 0.1, 0.1))]))
    assert reason_of(planner.plan_to_pose, REST, top_down(0.5, 0, 0.2)) == "goal_in_collision"
    tcp = planner.tcp(REST)[:3, 3]
    planner.set_scene(cloud([Box(tuple(tcp), (0.09, 0.09, 0.03))]))
    assert reason_of(planner.plan_to_qpos, REST, [REST + 0.3]) == "start_in_collision"
    assert reason_of(planner.plan_straight, REST, planner.tcp(REST) @ shifted(-0.1)) == "start_in_collision"
    assert reason_of(planner.plan_to_qpos, REST + [0, -1, 0, 0, 0, 0, 0], [REST]) == "start_outside_limits"
    assert reason_of(planner.plan_to_qpos, REST, [REST + [0, -1, 0, 0, 0, 0, 0]]) == "start_in_collision"
    planner.set_scene(np.zeros((0, 3)))
    outside = REST + [0, -1, 0, 0, 0, 0, 0]
    assert reason_of(planner.plan_to_qpos, REST, [outside]) == "goal_outside_limits"
    assert reason_of(planner.plan_to_qpos, REST, []) == "no_goals"
    folded = np.array([0.0, -1.7, 0.0, -3.0, 0.0, 0.0, 0.0])
    assert reason_of(planner.plan_to_qpos, REST, [outside, folded]) == "goal_in_collision"

    hurried = make_planner()
    monkeypatch.setattr(rrt_connect, "BUDGET", 50)
    hurried.set_scene(cloud([WALL]))
    start = hurried.ik(top_down(0.5, 0.25, 0.1), REST)[0]
    assert reason_of(hurried.plan_to_qpos, start, hurried.ik(top_down(0.5, -0.25, 0.1), start)[:1]) == "rrt_timeout"


def test_cloud_blocks_a_straight_line_unless_collisions_are_ignored(planner):
    start = planner.ik(top_down(0.5, 0, 0.3), REST)[0]
    goal = top_down(0.5, 0, 0.1)
    planner.set_scene(cloud([Box((0.5, 0, 0.12), (0.09, 0.09, 0.06))]))
    assert len(planner.plan_straight(start, top_down(0.5, 0, 0.2), stage="x").qpos) > 5
    assert reason_of(planner.plan_straight, start, goal) == "straight_line_blocked"
    assert len(planner.plan_straight(start, goal, stage="x", check_collisions=False).qpos) > 5


def test_self_collisions_of_a_straight_line_are_always_checked(planner):
    start = planner.ik(top_down(0.3, 0, 0.2), REST)[0]
    blocked = ("straight_line_blocked", "line_unreachable", "start_in_collision")
    for check in (True, False):
        assert reason_of(planner.plan_straight, start, top_down(0.12, 0, 0.0), check_collisions=check) in blocked
    planner.attach(AttachedBody(corners(0.05, 0.05, 0.15), np.eye(4)))
    assert len(planner.plan_straight(start, top_down(0.3, 0, 0.1), stage="x", check_collisions=False).qpos) > 5
    planner.attach(AttachedBody(corners(0.15, 0.15, 0.15), np.eye(4)))
    assert reason_of(planner.plan_straight, start, top_down(0.2, 0, 0.0), check_collisions=False) in blocked


def test_speed_scales_both_limits(planner):
    start, slowest = planner.ik(top_down(0.5, 0, 0.3), REST)[0], np.inf
    for speed in (0.1, 0.3, 1.0):
        trajectory = planner.plan_straight(start, top_down(0.5, 0, 0.1), stage="x", speed=speed)
        check_limits(start, trajectory, 0.5 * speed, 0.5 * speed)
        assert trajectory.duration < slowest
        slowest = trajectory.duration


def test_tcp_of_a_stretched_arm_keeps_its_speed_limit(planner):
    """Three joints at 0.5 rad/s move a hand at 0.8 m faster than pd_ee_delta_pose can follow."""
    start = np.array([-1.2, 0.9, -0.6, -0.7, 0.0, 1.7, 0.8])
    goal = start * [-1, 1, -1, 1, 1, 1, 1]
    trajectory = planner.plan_to_qpos(start, [goal], stage="sweep")
    check_limits(start, trajectory)
    places = np.array([planner.tcp(qpos)[:3, 3] for qpos in trajectory.qpos])
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / trajectory.dt
    assert 0.9 * TCP_SPEED_LIMIT < speeds.max() < 1.02 * TCP_SPEED_LIMIT
