"""Inverse kinematics with many starts."""

from __future__ import annotations

import numpy as np
import pytest
from planning_scenes import REST, top_down

from robocas_ms3.planning.collision import ArmWorld
from robocas_ms3.planning.kinematics import DISTINCT, LIMIT_MARGIN, ArmKinematics, pose_error


@pytest.fixture(scope="module")
def arm(panda_files) -> tuple[ArmWorld, ArmKinematics]:
    world = ArmWorld(panda_files.arm_urdf, panda_files.arm_srdf)
    return world, ArmKinematics(world)


def test_solutions_reach_the_pose_inside_the_limits_nearest_first(arm, checker):
    world, kinematics = arm
    rng, count = np.random.default_rng(0), 0
    for _ in range(20):
        goal = world.tcp(rng.uniform(kinematics.lower + 0.2, kinematics.upper - 0.2))
        found = kinematics.solutions(goal, REST, rng)
        count += bool(found)
        distances = [np.linalg.norm(qpos - REST) for qpos in found]
        assert distances == sorted(distances)
        for i, qpos in enumerate(found):
            distance, angle = pose_error(checker.link_pose("panda_hand_tcp", qpos), goal)
            assert distance <= 1e-4 and angle <= 1e-3
            assert np.all(qpos >= world.limits[:, 0] + LIMIT_MARGIN) and np.all(
                qpos <= world.limits[:, 1] - LIMIT_MARGIN
            )
            assert all(np.linalg.norm(qpos - other) >= DISTINCT for other in found[:i])
    assert count >= 19


def test_the_preferred_configuration_is_found_again(arm):
    world, kinematics = arm
    for qpos in REST + np.random.default_rng(1).uniform(-0.3, 0.3, (10, 7)):
        found = kinematics.solutions(world.tcp(qpos), qpos, np.random.default_rng(0))
        assert np.linalg.norm(found[0] - qpos) < 0.01


def test_the_generator_decides_everything(arm):
    _, kinematics = arm
    goal = top_down(0.5, 0.1, 0.2)
    runs = [kinematics.solutions(goal, REST, np.random.default_rng(seed)) for seed in (0, 0, 1)]
    assert [q.tobytes() for q in runs[0]] == [q.tobytes() for q in runs[1]]
    assert [q.tobytes() for q in runs[0]] != [q.tobytes() for q in runs[2]]


def test_out_of_reach_has_no_solution(arm):
    _, kinematics = arm
    for place in ((1.2, 0, 0.3), (0.0, 0.0, -0.3), (0.5, 0, 1.3)):
        assert kinematics.solutions(top_down(*place), REST, np.random.default_rng(0)) == []


@pytest.mark.parametrize(("turn", "expected"), [(0.0, 0.0), (1e-5, 1e-5), (0.7, 0.7), (2.5, 2.5), (np.pi, np.pi)])
def test_pose_error_by_hand(turn, expected):
    from scipy.spatial.transform import Rotation

    a, b = np.eye(4), np.eye(4)
    b[:3, :3], b[:3, 3] = Rotation.from_rotvec([0, turn, 0]).as_matrix(), (0.3, 0, 0.4)
    assert pose_error(a, b) == pytest.approx((0.5, expected), abs=1e-7)
