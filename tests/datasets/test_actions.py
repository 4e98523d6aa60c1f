import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets.actions import compute_actions, to_joint_positions


def test_joint_actions_of_a_dataset_become_joint_positions():
    """The gripper is 0 to 1 in datasets and -1 to 1 in the convention `joint_positions`; the joints stay."""
    joints = np.linspace(-1, 1, 21).reshape(3, 7)
    actions = to_joint_positions(np.column_stack([joints, [0.0, 0.5, 1.0]]))
    np.testing.assert_allclose(actions[:, :7], joints, atol=1e-7)
    assert actions[:, 7].tolist() == [-1, 0, 1]
    assert actions.dtype == np.float32


def test_euler_angles_of_actions_are_about_fixed_axes():
    """Fixed axes x, y, z: R = Rz Ry Rx."""
    roll, pitch, yaw = 0.2, -0.3, 0.4
    rotation = Rotation.from_euler("z", yaw) * Rotation.from_euler("y", pitch) * Rotation.from_euler("x", roll)
    turns = np.stack([rotation.as_quat(), [0, 0, 0, 1]])
    actions = compute_actions(
        {"rel_pos": np.zeros((2, 3)), "rel_orn": turns, "gripper_status": np.array([True, False])}
    )
    np.testing.assert_allclose(actions[0, 3:], [roll, pitch, yaw, 0], atol=1e-6)
