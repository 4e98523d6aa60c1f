"""Pulls along a joint, and collision checks of drives, compared with values computed by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from planning_scenes import REST

from robocas_ms3.assets.kinematics import joint_motion
from robocas_ms3.assets.manifest import Handle, Joint
from robocas_ms3.core.errors import PlanningError
from robocas_ms3.planning.protocol import AttachedBody, Obstacle, Shape
from robocas_ms3.planning.pull_path import MAX_SLIP, count_reached_poses, track_handle
from robocas_ms3.planning.skills.drive import Surroundings, find_free_route
from robocas_ms3.planning.skills.handles import MovingPart
from robocas_ms3.robots.description import MOBILE_PANDA

SLIDE = Joint(name="slide", kind="prismatic", axis=(-1.0, 0.0, 0.0), limits=(0.0, 0.6), friction=0, damping=0)
# 0.4 m to the right of the upright bar of the pull
HINGE = Joint(
    name="hinge", kind="revolute", axis=(0, 0, 1), origin=(0.7, -0.3, 0), limits=(0.0, 2.0), friction=0, damping=0
)


def level_hold(x: float, y: float, z: float) -> np.ndarray:
    """Return a TCP pose that points along +x and holds a vertical bar: x down, horizontal closing axis."""
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([(0, 0, -1), (0, 1, 0), (1, 0, 0)])
    pose[:3, 3] = x, y, z
    return pose


def angle_about_bar(found: np.ndarray, goal: np.ndarray) -> float:
    turn = goal[:3, :3].T @ found[:3, :3]
    return float(np.arctan2(turn[2, 1], turn[1, 1]))


@pytest.mark.parametrize(("joint", "end"), [(SLIDE, 0.25), (HINGE, 0.9)])
def test_all_poses_of_a_pull_hold_the_bar_at_the_joint_position(reachability, joint, end):
    hold = level_hold(0.7, 0.1, 0.5)
    goals = np.array([joint_motion(joint, q) @ hold for q in np.linspace(0, end, 25)])
    solved, start = reachability.nearest_solutions(goals[:1], np.array(REST))
    assert solved.all()
    path = track_handle(reachability.chain, start, goals)[:, 0]
    assert count_reached_poses(path[:, None])[0] == 25
    assert np.abs(np.diff(path, axis=0)).max() <= 0.2
    assert (path >= reachability.lower).all()
    assert (path <= reachability.upper).all()
    found, _ = reachability.chain.jacobian(path)
    assert found[:, :3, 3] == pytest.approx(goals[:, :3, 3], abs=1e-3)
    assert found[:, :3, 0] == pytest.approx(goals[:, :3, 0], abs=5e-3)  # the bar stays across the fingers
    slips = [abs(angle_about_bar(a, b)) for a, b in zip(found, goals, strict=True)]
    assert max(slips) <= MAX_SLIP + 5e-3


def test_pull_ends_at_the_limit_of_reach(reachability):
    hold = level_hold(0.6, 0.1, 0.5)
    away = Joint(name="away", kind="prismatic", axis=(1, 0, 0), limits=(0, 2), friction=0, damping=0)
    goals = np.array([joint_motion(away, q) @ hold for q in np.arange(0, 1.0, 0.02)])
    _, start = reachability.nearest_solutions(goals[:1], np.array(REST))
    path = track_handle(reachability.chain, start, goals)
    count = int(count_reached_poses(path)[0])
    assert 0.6 + 0.02 * count < 1.2  # the Panda's reach, long fingers included
    assert count > 3
    assert np.isnan(path[count:]).all()
    assert np.isfinite(path[:count]).all()


def test_route_keeps_the_held_object_collision_free(planner):
    robot = SimpleNamespace(pose=SimpleNamespace(raw_pose=torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]])))
    env = SimpleNamespace(agent=SimpleNamespace(robot=robot))
    arm = SimpleNamespace(env=env, robot=MOBILE_PANDA, planner=planner, qpos=np.array(REST))
    start, goal = np.zeros(3), np.array([0.24, 0.0, 0.0])
    planner.finger_width = 0.04
    beyond = planner.tcp(arm.qpos) @ np.array([0, 0, 0.10, 1])  # 0.10 m beyond the tips, at the goal of the base
    spot, there = np.random.default_rng(0).uniform(-0.01, 0.01, (600, 3)), np.eye(4)
    there[:3, 3] = beyond[:3] + [0.24, 0, 0.49]
    spot = Surroundings([Obstacle("spot", Shape(points=spot), there)], spot + there[:3, 3])
    assert len(find_free_route(arm, start, goal, spot, back_first=False)) == 1
    corners = np.stack(np.meshgrid((-0.02, 0.02), (-0.02, 0.02), (-0.02, 0.15)), axis=-1).reshape(-1, 3)
    planner.attach(AttachedBody(corners, np.eye(4)))
    assert find_free_route(arm, start, goal, spot, back_first=False) is None


def part_at(position, joint, monkeypatch):
    monkeypatch.setattr(MovingPart, "joint_position", lambda self, arm: position)
    handle = Handle(link="door", position=(0, 0, 0), wxyz=(1, 0, 0, 0), width=0.02)
    return MovingPart("cabinet", handle, joint)


@pytest.mark.parametrize("towards", [1, -1])
def test_pull_continues_from_the_position_of_the_joint(towards, monkeypatch):
    limits = tuple(sorted((0.0, towards * 0.4)))
    joint = Joint(name="slide", kind="prismatic", axis=(1, 0, 0), limits=limits, friction=0, damping=0)
    way = part_at(towards * 0.1, joint, monkeypatch).pull_positions(None)
    assert way[[0, -1]] == pytest.approx([towards * 0.1, towards * 0.38])  # 0.95 of the range
    assert len(way) == 20  # 0.28 m in steps of at most 0.015 m
    part = part_at(towards * 0.35, joint, monkeypatch)
    assert part.min_pull(None) == pytest.approx(0.03)  # a quarter of the range is more than what is left
    for position in (0.37, 0.38, 0.4):
        with pytest.raises(PlanningError, match="already_open"):
            part_at(towards * position, joint, monkeypatch).pull_positions(None)
