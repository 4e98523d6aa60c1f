"""Batched inverse kinematics against forward kinematics and against mplib's, one pose at a time."""

from __future__ import annotations

import time

import numpy as np
import pytest
from planning_scenes import REST, top_down
from scipy.spatial.transform import Rotation

from robocas_ms3.errors import RobocasError
from robocas_ms3.planning.collision import ArmWorld
from robocas_ms3.planning.kinematics import LIMIT_MARGIN, ArmKinematics, pose_error
from robocas_ms3.planning.reachability import Reachability, twist


@pytest.fixture(scope="module")
def arm(panda_files) -> tuple[ArmWorld, ArmKinematics]:
    world = ArmWorld(panda_files.arm_urdf, panda_files.arm_srdf)
    return world, ArmKinematics(world)


@pytest.fixture(scope="module")
def reachability(panda_files) -> Reachability:
    return Reachability(panda_files.arm_urdf)


def grasp_poses(count: int, seed: int) -> np.ndarray:
    """Poses over and around a table, leaning up to 60 deg from straight down."""
    rng, poses = np.random.default_rng(seed), []
    for _ in range(count):
        pose = top_down(rng.uniform(0.25, 0.9), rng.uniform(-0.5, 0.5), rng.uniform(-0.05, 0.3), rng.uniform(-3, 3))
        pose[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)).as_matrix() @ pose[:3, :3]
        poses.append(pose)
    return np.array(poses)


def test_jacobian_is_the_derivative_and_agrees_with_pytorch_kinematics(reachability, panda_files):
    import pytorch_kinematics as pk
    import torch

    qpos = np.random.default_rng(0).uniform(-1, 1, (4, 7))
    pose, jacobian = reachability.jacobian(qpos)
    for joint in range(7):
        step = np.zeros(7)
        step[joint] = 1e-6
        moved, _ = reachability.jacobian(qpos + step)
        np.testing.assert_allclose(twist(pose, moved) / 1e-6, jacobian[:, :, joint], atol=1e-5)
    text = panda_files.arm_urdf.read_bytes()
    chain = pk.build_serial_chain_from_urdf(text, "panda_hand_tcp", "panda_link0").to(dtype=torch.float64)
    theirs, their_pose = chain.jacobian(torch.as_tensor(qpos), ret_eef_pose=True)
    np.testing.assert_allclose(jacobian, theirs.numpy(), atol=1e-6)
    np.testing.assert_allclose(pose, their_pose.numpy(), atol=1e-6)


def test_found_configurations_reach_their_poses_inside_the_limits(reachability, arm, checker):
    world, _ = arm
    poses = grasp_poses(60, 0)
    solved, qpos = reachability.reachable(poses, REST)
    assert solved.dtype == bool and qpos.shape == (60, 7)
    assert 20 < solved.sum() < 60
    assert np.isnan(qpos[~solved]).all()
    for pose, found in zip(poses[solved], qpos[solved], strict=True):
        distance, angle = pose_error(checker.link_pose("panda_hand_tcp", found), pose)
        assert distance <= 1.1e-4 and angle <= 1.1e-3
        assert np.all(found >= world.limits[:, 0] + LIMIT_MARGIN) and np.all(found <= world.limits[:, 1] - LIMIT_MARGIN)


def test_it_agrees_with_mplib_on_reachable_and_unreachable_poses(reachability, arm):
    world, kinematics = arm
    rng = np.random.default_rng(1)
    reachable = np.array([world.tcp(rng.uniform(kinematics.lower + 0.1, kinematics.upper - 0.1)) for _ in range(100)])
    far = grasp_poses(50, 2)
    far[:25, 0, 3] += 1.0  # 1.25 m and more in front of the base
    far[25:, 2, 3] -= 1.2  # below the floor
    solved, _ = reachability.reachable(np.concatenate([reachable, far]), REST)
    assert solved[:100].mean() >= 0.97
    assert not solved[100:].any()
    poses = np.concatenate([reachable, far])
    theirs = np.array([bool(kinematics.solutions(pose, REST, rng)) for pose in poses])
    assert np.mean(theirs == solved) >= 0.95


def test_the_preferred_configuration_decides_between_solutions(reachability, arm):
    world, _ = arm
    for near in (REST, REST + [0.3, 0.2, -0.2, 0.1, 0.2, 0.1, -0.5]):
        solved, qpos = reachability.reachable(world.tcp(near)[None], near)
        assert solved[0]
        assert np.linalg.norm(qpos[0] - near) < 1e-3


def test_no_poses_and_wrong_files(reachability, tmp_path):
    solved, qpos = reachability.reachable(np.zeros((0, 4, 4)), REST)
    assert solved.shape == (0,) and qpos.shape == (0, 7)
    with pytest.raises(RobocasError, match="no such robot description"):
        Reachability(tmp_path / "none.urdf")


def test_256_grasps_take_half_a_second_and_answers_repeat(reachability):
    poses = grasp_poses(256, 3)
    start = time.process_time()
    first = reachability.reachable(poses, REST)
    assert time.process_time() - start < 1.0  # seconds of processor, twice the aim, whatever else the machine does
    second = reachability.reachable(poses, REST)
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])
