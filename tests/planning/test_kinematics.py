"""Rotation vectors, pose errors, and straight lines of the TCP."""

from __future__ import annotations

import numpy as np
import pytest
from planning_scenes import REST, pose_error, top_down
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.planning.kinematics import ArmChain, InverseKinematics, solve_straight_line, to_rotation_vectors
from robocas_ms3.robots.description import MOBILE_PANDA


@pytest.fixture(scope="module")
def chain(panda_files) -> ArmChain:
    return ArmChain(panda_files.arm_urdf, MOBILE_PANDA)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.5, np.pi / 2, 3.0, np.pi - 1e-4, np.pi - 1e-9, np.pi])
def test_rotation_vectors_invert_rotation_matrices(angle):
    axes = np.random.default_rng(0).normal(size=(20, 3))
    axes = np.concatenate([axes / np.linalg.norm(axes, axis=1, keepdims=True), np.eye(3)])
    matrices = Rotation.from_rotvec(angle * axes).as_matrix()
    vectors = to_rotation_vectors(matrices)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), angle, atol=1e-7)
    np.testing.assert_allclose(Rotation.from_rotvec(vectors).as_matrix(), matrices, atol=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_line_is_straight_and_ends_at_its_goal(chain, checker, seed):
    rng = np.random.default_rng(seed)
    above = top_down(rng.uniform(0.4, 0.6), rng.uniform(-0.2, 0.2), 0.3, yaw=rng.uniform(-1, 1))
    goal = above @ np.block(
        [[Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix(), np.zeros((3, 1))], [0, 0, 0, 1]]
    )
    goal[:3, 3] += rng.uniform((-0.05, -0.05, -0.15), (0.05, 0.05, 0.05))
    start = InverseKinematics(chain).distinct_solutions(above, REST)[0]
    path = solve_straight_line(chain, start, goal, stage="x")
    np.testing.assert_array_equal(path[0], start)
    assert (path >= chain.lower).all() and (path <= chain.upper).all()
    poses = np.array([checker.link_pose("panda_hand_tcp", qpos) for qpos in path])
    assert pose_error(poses[-1], goal) == pytest.approx((0, 0), abs=1e-6)
    fractions, turn = np.linspace(0, 1, len(path)), pose_error(above, goal)[1]
    for fraction, pose in zip(fractions, poses, strict=True):
        expected = above[:3, 3] + fraction * (goal - above)[:3, 3]
        np.testing.assert_allclose(pose[:3, 3], expected, atol=1e-6)
        assert pose_error(above, pose)[1] == pytest.approx(fraction * turn, abs=1e-6)
    steps = [pose_error(a, b) for a, b in zip(poses[:-1], poses[1:], strict=True)]
    assert np.max(steps, axis=0)[0] <= 0.01 + 1e-6 and np.max(steps, axis=0)[1] <= np.deg2rad(3) + 1e-6


def line_error(chain, start, goal) -> str:
    with pytest.raises(PlanningError) as caught:
        solve_straight_line(chain, start, goal, stage="here")
    assert caught.value.stage == "here"
    return caught.value.reason


def test_line_out_of_reach_is_an_error(chain):
    start = InverseKinematics(chain).distinct_solutions(top_down(0.5, 0, 0.3), REST)[0]
    assert line_error(chain, start, top_down(1.2, 0, 0.3)) in ("line_unreachable", "line_joint_jump")


def test_line_through_a_joint_limit_is_an_error(chain):
    """The last joint starts near its limit and would have to exceed it."""
    start = max(InverseKinematics(chain).distinct_solutions(top_down(0.5, 0, 0.3), REST), key=lambda qpos: qpos[6])
    assert len(solve_straight_line(chain, start, top_down(0.5, 0, 0.3, yaw=1.0), stage="x")) > 15
    assert line_error(chain, start, top_down(0.5, 0, 0.3, yaw=-2.0)) == "line_unreachable"
