"""One motion, said in every convention."""

import numpy as np
import pytest

from robocas_ms3.evaluation.policy import CONVENTIONS

QUARTER = np.pi / 2
SAID = {  # 1, 2, 3 cm, then a quarter turn about z; gripper open, then shut
    "robocas": ([0.01, 0.02, 0.03, 0, 0, QUARTER], 1.0, 0.5),
    "delta_euler": ([0.01, 0.02, 0.03, 0, 0, QUARTER], 0.1, -0.1),
    "delta_axis_angle": ([0.01, 0.02, 0.03, 0, 0, QUARTER], 1.0, 0.0),
    "delta_quaternion": ([0.01, 0.02, 0.03, 2.0, 0, 0, 2.0], 0.2, -1.0),  # of any length
}


@pytest.mark.parametrize("name", SAID)
def test_a_motion_is_read(name):
    numbers, opened, shut = SAID[name]
    convention = CONVENTIONS[name]
    assert len(numbers) + 1 == convention.size
    assert convention.read is not None
    motion = convention.read(np.array([[*numbers, opened], [*numbers, shut]]))
    np.testing.assert_allclose(motion.translation, [[0.01, 0.02, 0.03]] * 2)
    np.testing.assert_allclose(motion.rotation.apply([1.0, 0, 0]), [[0, 1.0, 0]] * 2, atol=1e-12)
    assert motion.open.tolist() == [True, False]


def test_euler_angles_are_about_fixed_axes_x_first():
    read = CONVENTIONS["robocas"].read
    assert read is not None
    turn = read(np.array([[0, 0, 0, QUARTER, 0, QUARTER, 1.0]])).rotation
    np.testing.assert_allclose(turn.apply([[0, 1.0, 0]]), [[0, 0, 1.0]], atol=1e-12)  # up by x, then z leaves it


def test_a_quaternion_of_nothing_is_no_turn():
    read = CONVENTIONS["delta_quaternion"].read
    assert read is not None
    assert read(np.zeros((1, 8))).rotation.magnitude() == pytest.approx(0)
