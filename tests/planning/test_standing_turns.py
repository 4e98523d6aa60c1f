"""The least turn after which a body stands, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robocas_ms3.planning.skills.removing import turn_to_stand

BOX = np.array([[x, y, z] for x in (-0.01, 0.01) for y in (-0.02, 0.02) for z in (-0.05, 0.05)])


def corners(shift):
    """A box of 2 x 2 x 4 cm whose top is shifted along x."""
    return np.array([[x + shift * z / 0.04, y, z] for x in (0, 0.02) for y in (0, 0.02) for z in (0, 0.04)])


@pytest.mark.parametrize("turned_deg", [(20, 0, 0), (0, -35, 0), (0, 0, 70)])
def test_leaning_object_is_turned_upright_about_level_axes(turned_deg):
    leant = Rotation.from_euler("xyz", turned_deg, degrees=True)
    expected = leant.inv().as_matrix() if turned_deg[2] == 0 else np.eye(3)
    turn = turn_to_stand(leant.apply(BOX), np.zeros(3))
    np.testing.assert_allclose(turn[:3, :3], expected, atol=1e-9)
    np.testing.assert_array_equal(turn[:3, 3], 0)


def test_beyond_half_of_a_right_angle_it_is_laid_on_the_next_side():
    leant = Rotation.from_euler("x", 50, degrees=True)
    turn = turn_to_stand(leant.apply(BOX), np.zeros(3))
    np.testing.assert_allclose(turn[:3, :3], Rotation.from_euler("x", 40, degrees=True).as_matrix(), atol=1e-9)


def test_face_beside_the_centre_of_mass_is_not_a_standing_face():
    # its foot reaches to x = 2 cm, its middle is at 1.5 cm, then at 2.5 cm: it falls onto the side (3, 4) cm long
    np.testing.assert_array_equal(turn_to_stand(corners(0.01), corners(0.01).mean(axis=0)), np.eye(4))
    turn = turn_to_stand(corners(0.03), corners(0.03).mean(axis=0))
    expected = Rotation.from_rotvec([0, np.arccos(0.6), 0]).as_matrix()
    np.testing.assert_allclose(turn[:3, :3], expected, atol=1e-9)
