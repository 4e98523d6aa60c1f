"""Score of base poses, without a simulator."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from planning_scenes import REST

from robocas_ms3.planning.skills import base_placement
from robocas_ms3.planning.skills.drive import arm_base_in_world
from robocas_ms3.robots.description import MOBILE_PANDA


class _Planner:
    """Planner stand-in in which only configurations near ``blocked`` collide."""

    def __init__(self) -> None:
        self.blocked = np.empty((0, 7))

    def set_scene(self, obstacles) -> None:
        assert obstacles == []

    def is_free(self, qpos) -> np.ndarray:
        away = np.abs(qpos[:, None] - self.blocked[None]).max(axis=2)
        return (away > 1e-6).all(axis=1)


@pytest.fixture
def arm(reachability):
    robot = SimpleNamespace(pose=SimpleNamespace(raw_pose=np.array([[0.0, 0, 0, 1, 0, 0, 0]])))
    env = SimpleNamespace(agent=SimpleNamespace(robot=robot))
    tools = {"robot": MOBILE_PANDA, "inverse_kinematics": reachability, "planner": _Planner()}
    return SimpleNamespace(env=env, qpos=REST, approach="top", **tools)


def grasps_in_world(arm) -> np.ndarray:
    """Return eight top-down grasps in front of the arm with different yaw angles."""
    poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (8, 1, 1))
    for pose, turn in zip(poses, np.linspace(-1, 1, 8), strict=True):
        c, s = np.cos(turn), np.sin(turn)
        pose[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ pose[:3, :3]
        pose[:3, 3] = 0.5, 0.0, 0.1
    return arm_base_in_world(arm, np.zeros(3)) @ poses


def test_thorough_check_finds_free_configurations_other_than_the_nearest(arm):
    grasps, here = grasps_in_world(arm), np.zeros(3)
    assert base_placement.estimate_reachable_fraction(arm, here, grasps, []) == 1.0
    assert base_placement.estimate_reachable_fraction(arm, here, grasps, [], thorough=True) == 1.0
    poses = base_placement._sample_grasp_poses(arm, arm_base_in_world(arm, here), grasps, len(grasps))
    solved, nearest = arm.inverse_kinematics.nearest_solutions(poses, REST)
    assert solved.all()
    arm.planner.blocked = nearest
    assert base_placement.estimate_reachable_fraction(arm, here, grasps, []) == 0.0
    assert base_placement.estimate_reachable_fraction(arm, here, grasps, [], thorough=True) == 1.0


def test_a_grasp_counts_only_with_its_pregrasp(arm):
    grasps, here = grasps_in_world(arm), np.zeros(3)
    poses = base_placement._sample_grasp_poses(arm, arm_base_in_world(arm, here), grasps, len(grasps))
    half = len(poses) // 2
    everything, of_pose = arm.inverse_kinematics.all_solutions(poses, REST)
    arm.planner.blocked = everything[of_pose >= half]  # each way in
    assert base_placement.estimate_reachable_fraction(arm, here, grasps, [], thorough=True) == 0.0
    one_and_its_half_turn = np.isin(of_pose, [half, half + len(grasps)])
    arm.planner.blocked = everything[one_and_its_half_turn]
    assert base_placement.estimate_reachable_fraction(arm, here, grasps, [], thorough=True) == pytest.approx(7 / 8)


def test_unreachable_grasps_and_no_grasps_score_zero(arm):
    grasps = grasps_in_world(arm)
    for far in (grasps + np.array([[0, 0, 0, 2.0]] + [[0, 0, 0, 0]] * 3), grasps[:0]):
        assert base_placement.estimate_reachable_fraction(arm, np.zeros(3), far, []) == 0.0
        assert base_placement.estimate_reachable_fraction(arm, np.zeros(3), far, [], thorough=True) == 0.0
