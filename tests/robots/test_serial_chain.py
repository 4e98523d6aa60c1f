"""Inverse kinematics on NumPy's arrays (on a CPU) and on tensors (on a GPU), against poses by the URDF."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.utils._python_dispatch import TorchDispatchMode

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.robots.description import MOBILE_PANDA
from robocas_ms3.robots.description_file import chain_poses as urdf_pose
from robocas_ms3.robots.kinematics import SerialChain
from robocas_ms3.robots.urdf import make_robot_files

LOWER, UPPER = np.array(MOBILE_PANDA.arm_limits).T
ARM = (make_robot_files().arm_urdf, MOBILE_PANDA.arm_base_link, MOBILE_PANDA.tcp_link)

TWO_LINKS = """<robot name="two">
  <link name="base"/><link name="upper"/><link name="bend"/><link name="lower"/><link name="tip"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.5" rpy="0 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="rod" type="fixed"><parent link="upper"/><child link="bend"/><origin xyz="0.3 0 0" rpy="0 0 0"/></joint>
  <joint name="elbow" type="KIND"><parent link="bend"/><child link="lower"/><axis xyz="0 -2 0"/></joint>
  <joint name="end" type="fixed"><parent link="lower"/><child link="tip"/>
    <origin xyz="0.2 0 0" rpy="0 0 1.5707963267948966"/></joint>
</robot>"""


def arrays(*values: np.ndarray) -> tuple:
    return values


def tensors(*values: np.ndarray) -> tuple:
    return tuple(torch.tensor(value, dtype=torch.float64) for value in values)


@pytest.fixture(params=[arrays, tensors])
def kind(request) -> Callable[..., tuple]:
    return request.param


@pytest.fixture
def arm(kind) -> SerialChain:
    return SerialChain(*ARM, device=torch.device("cpu") if kind is tensors else None)


def two_links(folder: Path, kind: str = "revolute") -> Path:
    path = folder / "two.urdf"
    path.write_text(TWO_LINKS.replace("KIND", kind))
    return path


def pose_at(chain: tuple, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 3) and quaternions wxyz (N, 4) at configurations (N, n), by the URDF."""
    pose = urdf_pose(*chain, qpos)
    return pose[:, :3, 3], Rotation.from_matrix(pose[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]


def test_only_revolute_and_fixed_joints(tmp_path):
    with pytest.raises(RobocasError) as raised:
        SerialChain(two_links(tmp_path, "prismatic"), "base", "tip")
    assert "elbow" in str(raised.value.where)


def nearby_goals(kind: Callable[..., tuple], *, count: int, away: float, seed: int) -> tuple:
    """Poses of configurations within the limits, up to ``away`` rad from starts (count, 7), and the limits."""
    start = np.random.default_rng(seed).uniform(LOWER, UPPER, (count, 7))
    goal = start + np.random.default_rng(seed + 1).uniform(-away, away, start.shape)
    return kind(*pose_at(ARM, goal.clip(LOWER, UPPER)), start, LOWER, UPPER)


@pytest.mark.parametrize(("away", "least"), [(0.02, 1.0), (0.1, 0.995), (0.3, 0.98), (0.6, 0.95)])
def test_inverse_kinematics_reach_targets_within_the_limits(kind, arm, away, least):
    position, quaternion, start, lower, upper = nearby_goals(kind, count=400, away=away, seed=2)
    qpos, solved = arm.solve_inverse(position, quaternion, start, lower, upper)
    assert np.mean(np.asarray(solved)) >= least
    assert ((qpos >= lower) & (qpos <= upper)).all()
    found, turned = pose_at(ARM, np.asarray(qpos[solved]))
    assert np.linalg.norm(found - np.asarray(position[solved]), axis=1).max() < 1e-4
    cosine = np.abs((turned * np.asarray(quaternion[solved])).sum(axis=1))  # of half the angle between them
    assert 2 * np.arccos(cosine.clip(max=1)).max() < 1.01e-4


def test_targets_out_of_reach_are_not_solved(kind, arm):
    position, quaternion, start, lower, upper = nearby_goals(kind, count=50, away=0.1, seed=4)
    position[:, 0] = 2.0
    qpos, solved = arm.solve_inverse(position, quaternion, start, lower, upper)
    assert not solved.any()
    assert ((qpos >= lower) & (qpos <= upper)).all()


def test_solutions_stay_within_the_joint_limits(kind, tmp_path):
    chain = SerialChain(two_links(tmp_path), "base", "tip", torch.device("cpu") if kind is tensors else None)
    goals = np.array([[0.1, 0.4], [0.1, 0.6], [-0.7, 0.3]])
    position, quaternion = kind(*pose_at((two_links(tmp_path), "base", "tip"), goals))
    limits = np.array([-0.5, -0.5]), np.array([0.5, 0.5])
    qpos, solved = chain.solve_inverse(position, quaternion, *kind(np.zeros((3, 2)), *limits))
    assert solved.tolist() == [True, False, False]
    np.testing.assert_allclose(qpos[0], goals[0], atol=2e-5)
    assert qpos[1][1] == 0.5
    assert qpos[2][0] == -0.5


def test_a_target_turned_by_180_degrees_is_not_solved(kind, tmp_path):
    chain = SerialChain(two_links(tmp_path), "base", "upper", torch.device("cpu") if kind is tensors else None)
    position, quaternion = kind(*pose_at((two_links(tmp_path), "base", "upper"), np.array([[np.pi]])))
    qpos, solved = chain.solve_inverse(position, quaternion, *kind(np.zeros((1, 1)), np.array([-2.0]), np.array([2.0])))
    assert not solved.any()
    assert abs(float(qpos[0, 0])) > 1  # on its way


def test_a_batch_of_tensors_gives_the_solutions_of_single_arrays():
    """What a GPU computes and what a CPU does: the same configurations, and the same targets given up."""
    single, batched = SerialChain(*ARM), SerialChain(*ARM, device=torch.device("cpu"))
    goals = [nearby_goals(arrays, count=150, away=away, seed=8) for away in (0.02, 0.1, 0.2)]
    position, quaternion, start = (np.concatenate([goal[i] for goal in goals]) for i in range(3))
    position[:20] += [1.0, 0, 0]
    start[:40] = start[:40].clip(LOWER, LOWER + 0.05)  # targets beyond the limits of many joints
    tensor = tensors(position, quaternion, start, LOWER, UPPER)
    together, solved = (values.numpy() for values in batched.solve_inverse(*tensor))
    alone = [
        single.solve_inverse(position[i : i + 1], quaternion[i : i + 1], start[i : i + 1], LOWER, UPPER)
        for i in range(450)
    ]
    assert solved.tolist() == [bool(reached[0]) for _, reached in alone]
    assert 20 < np.sum(~solved) < 60
    found = np.concatenate([qpos for qpos, _ in alone])
    np.testing.assert_allclose(together[solved], found[solved], atol=1e-6)


class Operations(TorchDispatchMode):
    """Records the names of the tensor operations within it."""

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.add(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))


def test_no_operation_synchronizes_with_a_gpu():
    """Neither values are read, nor errors of linear algebra checked, nor rows counted that a mask selects."""
    arm = SerialChain(*ARM, device=torch.device("cpu"))
    goals = nearby_goals(tensors, count=5, away=0.1, seed=9)
    with Operations() as operations:
        arm.solve_inverse(*goals)
    assert "bmm" in operations.names
    waits = {"_local_scalar_dense", "nonzero", "is_nonzero", "equal", "_linalg_check_errors", "masked_select", "index"}
    assert not operations.names & waits
