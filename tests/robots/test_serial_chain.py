"""Forward and inverse kinematics on NumPy's arrays (on a CPU) and on tensors (on a GPU), against other libraries."""

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
from robocas_ms3.robots.description_file import chain as urdf_pose
from robocas_ms3.robots.kinematics import SerialChain
from robocas_ms3.robots.urdf import robot_files

LOWER, UPPER = np.array(MOBILE_PANDA.arm_limits).T
ARM = (robot_files().arm_urdf, MOBILE_PANDA.arm_base_link, MOBILE_PANDA.tcp_link)

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


def configurations(count: int, seed: int) -> np.ndarray:
    """Configurations (count, 7) anywhere within the limits."""
    return np.random.default_rng(seed).uniform(LOWER, UPPER, (count, 7))


def two_links(folder: Path, kind: str = "revolute") -> Path:
    path = folder / "two.urdf"
    path.write_text(TWO_LINKS.replace("KIND", kind))
    return path


def matrices(quaternion: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix()


def test_two_links_by_hand(tmp_path):
    chain = SerialChain(two_links(tmp_path), "base", "tip")
    assert chain.joint_names == ("shoulder", "elbow")
    quarter = np.pi / 2
    qpos = np.array([[0, 0], [quarter, 0], [0, quarter], [quarter, quarter]])
    position, quaternion = chain.forward(qpos)
    # The elbow turns about -y: the lower link, along x, is lifted to z.
    expected = [[0.5, 0, 0.5], [0, 0.5, 0.5], [0.3, 0, 0.7], [0, 0.3, 0.7]]
    np.testing.assert_allclose(position, expected, atol=1e-12)
    x_of_tip = matrices(quaternion)[:, :, 0]  # turned by 90 deg about the lower link's z
    np.testing.assert_allclose(x_of_tip, [[0, 1, 0], [-1, 0, 0], [0, 1, 0], [-1, 0, 0]], atol=1e-12)
    jacobian = chain.jacobian(qpos[:1])[0]
    np.testing.assert_allclose(jacobian[:, 0], [0, 0.5, 0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(jacobian[:, 1], [0, 0, 0.2, 0, -1, 0], atol=1e-12)


def test_only_revolute_and_fixed_joints(tmp_path):
    with pytest.raises(RobocasError) as raised:
        SerialChain(two_links(tmp_path, "prismatic"), "base", "tip")
    assert "elbow" in str(raised.value.where)


def test_forward_kinematics_agree_with_the_urdf(kind, arm):
    qpos = configurations(100, 0)
    position, quaternion = map(np.asarray, arm.forward(*kind(qpos)))
    pose = urdf_pose(*ARM, qpos)
    np.testing.assert_allclose(position, pose[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(matrices(quaternion), pose[:, :3, :3], atol=1e-12)


def nearby_goals(arm: SerialChain, kind: Callable[..., tuple], *, count: int, away: float, seed: int) -> tuple:
    """Starts (count, 7) and the poses of configurations within the limits, up to ``away`` rad from them."""
    start = configurations(count, seed)
    goal = start + np.random.default_rng(seed + 1).uniform(-away, away, start.shape)
    position, quaternion = arm.forward(*kind(goal.clip(LOWER, UPPER)))
    return position, quaternion, *kind(start, LOWER, UPPER)


@pytest.mark.parametrize(("away", "least"), [(0.02, 1.0), (0.1, 0.995), (0.3, 0.98), (0.6, 0.95)])
def test_inverse_kinematics_reach_targets_within_the_limits(kind, arm, away, least):
    position, quaternion, start, lower, upper = nearby_goals(arm, kind, count=400, away=away, seed=2)
    qpos, solved = arm.inverse(position, quaternion, start, lower, upper)
    assert np.mean(np.asarray(solved)) >= least
    assert ((qpos >= lower) & (qpos <= upper)).all()
    found, turned = arm.forward(qpos[solved])
    assert np.linalg.norm(found - position[solved], axis=1).max() < 1e-4
    turn = Rotation.from_matrix(matrices(np.asarray(turned)) @ matrices(np.asarray(quaternion[solved])).swapaxes(1, 2))
    assert turn.magnitude().max() < 1.01e-4


def test_targets_out_of_reach_are_not_solved(kind, arm):
    position, quaternion, start, lower, upper = nearby_goals(arm, kind, count=50, away=0.1, seed=4)
    position[:, 0] = 2.0
    qpos, solved = arm.inverse(position, quaternion, start, lower, upper)
    assert not solved.any()
    assert ((qpos >= lower) & (qpos <= upper)).all()


def test_solutions_stay_within_the_joint_limits(kind, tmp_path):
    chain = SerialChain(two_links(tmp_path), "base", "tip", torch.device("cpu") if kind is tensors else None)
    goals = np.array([[0.1, 0.4], [0.1, 0.6], [-0.7, 0.3]])
    position, quaternion = chain.forward(*kind(goals))
    limits = np.array([-0.5, -0.5]), np.array([0.5, 0.5])
    qpos, solved = chain.inverse(position, quaternion, *kind(np.zeros((3, 2)), *limits))
    assert solved.tolist() == [True, False, False]
    np.testing.assert_allclose(qpos[0], goals[0], atol=2e-5)
    assert qpos[1][1] == 0.5
    assert qpos[2][0] == -0.5


def test_a_target_turned_by_180_degrees_is_not_solved(kind, tmp_path):
    chain = SerialChain(two_links(tmp_path), "base", "upper", torch.device("cpu") if kind is tensors else None)
    position, quaternion = chain.forward(*kind(np.array([[np.pi]])))
    qpos, solved = chain.inverse(position, quaternion, *kind(np.zeros((1, 1)), np.array([-2.0]), np.array([2.0])))
    assert not solved.any()
    assert abs(float(qpos[0, 0])) > 1  # on its way


def test_a_batch_of_tensors_is_solved_as_single_arrays_are():
    """What a GPU computes and what a CPU does: the same configurations, and the same targets given up."""
    single, batched = SerialChain(*ARM), SerialChain(*ARM, device=torch.device("cpu"))
    goals = [nearby_goals(single, arrays, count=150, away=away, seed=8) for away in (0.02, 0.1, 0.2)]
    position, quaternion, start = (np.concatenate([goal[i] for goal in goals]) for i in range(3))
    position[:20] += [1.0, 0, 0]
    start[:40] = start[:40].clip(LOWER, LOWER + 0.05)  # targets beyond the limits of many joints
    tensor = tensors(position, quaternion, start, LOWER, UPPER)
    together, solved = (values.numpy() for values in batched.inverse(*tensor))
    alone = [
        single.inverse(position[i : i + 1], quaternion[i : i + 1], start[i : i + 1], LOWER, UPPER) for i in range(450)
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


def test_no_operation_waits_for_a_gpu():
    """Neither values are read, nor errors of linear algebra checked, nor rows counted that a mask selects."""
    arm = SerialChain(*ARM, device=torch.device("cpu"))
    goals = nearby_goals(arm, tensors, count=5, away=0.1, seed=9)
    with Operations() as operations:
        arm.inverse(*goals)
    assert "bmm" in operations.names
    waits = {"_local_scalar_dense", "nonzero", "is_nonzero", "equal", "_linalg_check_errors", "masked_select", "index"}
    assert not operations.names & waits
