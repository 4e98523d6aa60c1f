"""Closed-form inverse kinematics compared with forward kinematics and known configurations."""

from __future__ import annotations

import numpy as np
import pytest
from planning_scenes import REST, pose_error, top_down
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.planning.analytic import PandaInverseKinematics
from robocas_ms3.planning.kinematics import MIN_SOLUTION_DISTANCE, ArmChain, InverseKinematics, joint_distance
from robocas_ms3.planning.pull_path import pose_difference
from robocas_ms3.robots.description import MOBILE_PANDA


def grasp_poses(count: int, seed: int) -> np.ndarray:
    """Return poses above and around a table, tilted up to 60 deg from straight down."""
    rng, poses = np.random.default_rng(seed), []
    for _ in range(count):
        pose = top_down(rng.uniform(0.25, 0.9), rng.uniform(-0.5, 0.5), rng.uniform(-0.05, 0.3), rng.uniform(-3, 3))
        pose[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)).as_matrix() @ pose[:3, :3]
        poses.append(pose)
    return np.array(poses)


def test_jacobian_equals_the_numerical_derivative(reachability):
    qpos = np.random.default_rng(0).uniform(-1, 1, (4, 7))
    pose, jacobian = reachability.chain.jacobian(qpos)
    for joint in range(7):
        step = np.zeros(7)
        step[joint] = 1e-6
        moved, _ = reachability.chain.jacobian(qpos + step)
        np.testing.assert_allclose(pose_difference(pose, moved) / 1e-6, jacobian[:, :, joint], atol=1e-5)


def random_configurations(chain: ArmChain, count: int, seed: int) -> np.ndarray:
    """Return random configurations (count, 7) with the elbow bent by more than 27 deg."""
    qpos = np.random.default_rng(seed).uniform(chain.lower, chain.upper, (count, 7))
    qpos[:, 3] = np.minimum(qpos[:, 3], -0.48)
    return qpos


def test_solver_finds_configurations_at_their_own_joint_7(reachability):
    chain = reachability.chain
    qpos = random_configurations(chain, 2000, 0)
    found = PandaInverseKinematics(chain).solve(chain.tcp(qpos), qpos[:, 6])
    away = np.nanmin(np.abs(found - qpos[:, None]).max(axis=2), axis=1)
    assert np.mean(away < 1e-6) > 0.99
    rows, branches = np.nonzero(np.isfinite(found[..., 0]))
    assert len(rows) > 2 * len(qpos)
    np.testing.assert_allclose(chain.tcp(found[rows, branches]), chain.tcp(qpos)[rows], atol=1e-9)


def test_solutions_reach_their_poses_within_the_limits(reachability, checker):
    poses = grasp_poses(60, 0)
    solved, qpos = reachability.nearest_solutions(poses, REST)
    assert solved.dtype == bool and qpos.shape == (60, 7)
    assert 20 < solved.sum() < 60
    assert np.isnan(qpos[~solved]).all()
    for pose, found in zip(poses[solved], qpos[solved], strict=True):
        distance, angle = pose_error(checker.link_pose("panda_hand_tcp", found), pose)
        assert distance <= 1e-9 and angle <= 1e-7
        assert np.all(found >= reachability.lower) and np.all(found <= reachability.upper)


def test_nearest_solution_is_returned(reachability):
    for near in (REST, REST + [0.3, 0.2, -0.2, 0.1, 0.2, 0.1, -0.5]):
        pose = reachability.chain.tcp(near[None])
        solved, qpos = reachability.nearest_solutions(pose, near)
        assert solved[0]
        assert np.linalg.norm(qpos[0] - near) < 1e-6
        assert np.linalg.norm(reachability.distinct_solutions(pose[0], near)[0] - near) < 1e-6


def test_solutions_of_one_pose_are_distinct_and_sorted_by_distance(reachability):
    found = reachability.distinct_solutions(top_down(0.5, 0.1, 0.2), REST)
    assert len(found) > 5
    away = [float(joint_distance(qpos, REST)) for qpos in found]
    assert away == sorted(away)
    for i, qpos in enumerate(found):
        assert all(np.linalg.norm(qpos - other) >= MIN_SOLUTION_DISTANCE for other in found[:i])
        np.testing.assert_allclose(reachability.chain.tcp(qpos[None])[0], top_down(0.5, 0.1, 0.2), atol=1e-9)
    for place in ((1.2, 0, 0.3), (0.0, 0.0, -0.3), (0.5, 0, 1.3)):
        assert reachability.distinct_solutions(top_down(*place), REST) == []


def test_all_solutions_returns_all_configurations_of_all_poses(reachability):
    poses = np.concatenate([grasp_poses(20, 3), top_down(1.2, 0, 0.3)[None]])  # the last one is out of reach
    qpos, of_pose = reachability.all_solutions(poses, REST)
    np.testing.assert_allclose(reachability.chain.tcp(qpos), poses[of_pose], atol=1e-9)
    solved, nearest = reachability.nearest_solutions(poses, REST)
    np.testing.assert_array_equal(np.unique(of_pose), np.flatnonzero(solved))
    for pose in np.flatnonzero(solved):
        own = qpos[of_pose == pose]
        assert len(own) > 1
        assert (own == nearest[pose]).all(axis=1).any()


def test_results_do_not_depend_on_memory_alignment(reachability):
    """arctan2 of strided arrays depends on it: one call in a hundred differed in the last bit."""
    pose, kept = top_down(0.5, -0.25, 0.2, yaw=0.3), []
    first = np.array(reachability.distinct_solutions(pose, REST))
    for size in np.random.default_rng(0).integers(1, 400, 600):
        kept = [*kept[-20:], np.zeros(size)]
        np.testing.assert_array_equal(np.array(reachability.distinct_solutions(pose, REST)), first)


def test_closed_form_for_another_arm_is_an_error(panda_files):
    chain = ArmChain(panda_files.arm_urdf, MOBILE_PANDA)
    chain.links[2] = chain.links[2].copy()
    chain.links[2][0, 3] += 0.1
    with pytest.raises(
        RobocasError, match="robocas_mobile_panda: closed-form inverse kinematics do not fit the arm .*inverse_kinem"
    ):
        InverseKinematics(chain)
