from functools import cache

import numpy as np
import pytest
import trimesh

from asset_tools.grasps import sample_grasps
from robocas_ms3.scenes.grasp_checks import is_gripper_clear


def cup():
    """Open cup, outer radius 6 cm, wall 4 mm, bottom at z = -0.05, rim at z = 0.05."""
    profile = [(0, -0.05), (0.06, -0.05), (0.06, 0.05), (0.056, 0.05), (0.056, -0.045), (0, -0.045)]
    return trimesh.creation.revolve(np.array(profile), sections=96)


SHAPES = {
    "box": lambda: trimesh.creation.box((0.05, 0.12, 0.12)),
    "cylinder": lambda: trimesh.creation.cylinder(0.033, 0.1, sections=64),
    "sphere": lambda: trimesh.creation.icosphere(4, 0.036),
    "cup": cup,
}


@cache
def mesh_and_grasps(name):
    mesh = SHAPES[name]()
    return mesh, sample_grasps(mesh, np.zeros(3), np.random.default_rng(3))


def towards(grasps, direction, cosine=0.9):
    return int(np.sum(grasps.tcp_in_object[:, :3, 2] @ np.asarray(direction, dtype=float) >= cosine))


@pytest.mark.parametrize("name", SHAPES)
def test_frames_and_clearance(name):
    mesh, grasps = mesh_and_grasps(name)
    assert len(grasps) == 400
    assert grasps.tcp_in_object.shape == (400, 4, 4) and grasps.qualities.shape == (400,)
    rotations = grasps.tcp_in_object[:, :3, :3]
    np.testing.assert_allclose(rotations.transpose(0, 2, 1) @ rotations, np.tile(np.eye(3), (400, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-9)
    np.testing.assert_array_equal(grasps.tcp_in_object[:, 3], np.tile([0, 0, 0, 1], (400, 1)))
    assert grasps.qualities.min() >= 0.1 and grasps.qualities.max() <= 1
    # Other samples than those the sampler tested: a grasp may pass a corner by less than their spacing, no more.
    samples = trimesh.sample.sample_surface(mesh, 3000, seed=8)[0]
    assert is_gripper_clear(grasps.tcp_in_object, samples).mean() >= 0.95


def test_box_is_held_across_its_thin_side():
    _, grasps = mesh_and_grasps("box")
    closing = grasps.tcp_in_object[:, :3, 1]
    assert np.abs(closing[:, 0]).min() >= np.cos(np.arctan(0.2)) - 1e-9  # each face's normal is +-x
    np.testing.assert_allclose(grasps.qualities, np.maximum(np.sqrt(1 / closing[:, 0] ** 2 - 1), 0.1), atol=1e-4)
    assert grasps.qualities.max() <= 0.2
    # Tilted fingers need 0.05 / cos(atan(0.2)) = 0.051 m and at most 4 mm more for each.
    assert grasps.widths.min() >= 0.05 - 1e-6 and grasps.widths.max() <= 0.051 + 0.008
    assert np.median(grasps.widths) <= 0.052
    for direction in ((0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)):
        assert towards(grasps, direction) >= 40
    # The palm stays outside, so the TCP is at most 6.7 cm deep, under the face that the approach enters by.
    approach, tcp = grasps.tcp_in_object[:, :3, 2], grasps.tcp_in_object[:, :3, 3]
    down = approach[:, 2] < -0.99
    assert tcp[down, 2].min() >= 0.06 - 0.068 and tcp[down, 2].max() <= 0.06 + 1e-3


def test_cylinder_is_held_across_and_from_everywhere():
    _, grasps = mesh_and_grasps("cylinder")
    closing, middle = grasps.tcp_in_object[:, :3, 1], grasps.tcp_in_object[:, :3, 3]
    assert np.abs(closing[:, 2]).max() <= np.sin(np.arctan(0.41))  # its 10 cm of height do not fit in the gripper
    assert grasps.widths.min() >= 0.063
    assert np.median(grasps.widths) == pytest.approx(0.066, abs=0.003)
    off_axis = np.abs(np.einsum("ni,ni->n", np.cross(closing, [0, 0, 1]), middle))
    assert np.median(off_axis) <= 0.02  # the deeper grasps shift the TCP along the approach, at most 2 cm
    for direction in np.concatenate([np.eye(3), -np.eye(3)]):
        assert towards(grasps, direction, 0.85) >= 15


def test_wide_cup_is_held_by_its_wall():
    _, grasps = mesh_and_grasps("cup")
    tcp, approach = grasps.tcp_in_object[:, :3, 3], grasps.tcp_in_object[:, :3, 2]
    contact = tcp - np.clip(np.einsum("ni,ni->n", tcp - [0, 0, 0.05], approach), -0.004, 0.02)[:, None] * approach
    assert grasps.widths.max() <= 0.02  # the wall, not the 12 cm across
    assert np.linalg.norm(contact[:, :2], axis=1).min() >= 0.03
    assert approach[:, 2].max() <= 0.2  # the bottom is closed: no finger gets in from below
    assert towards(grasps, (0, 0, -1), 0.85) >= 100


def test_the_same_random_state_gives_the_same_grasps():
    mesh, first = mesh_and_grasps("box")
    again = sample_grasps(mesh, np.zeros(3), np.random.default_rng(3))
    other = sample_grasps(mesh, np.zeros(3), np.random.default_rng(4), count=50)
    np.testing.assert_array_equal(first.tcp_in_object, again.tcp_in_object)
    np.testing.assert_array_equal(first.widths, again.widths)
    assert len(other) == 50 and not np.allclose(other.tcp_in_object, first.tcp_in_object[:50])


def test_sphere_is_held_through_its_centre():
    _, grasps = mesh_and_grasps("sphere")
    closing, approach, tcp = (grasps.tcp_in_object[:, :3, i] for i in (1, 2, 3))
    depth = np.einsum("ni,ni->n", tcp, approach)
    # Off centre by s, both contacts lie at asin(s / r) to the normal, so mu <= 0.2 keeps s under 0.2 r.
    assert np.linalg.norm(tcp - depth[:, None] * approach, axis=1).max() <= 0.2 * 0.036 + 5e-4
    assert np.abs(np.einsum("ni,ni->n", tcp, closing)).max() <= 1e-3
    assert grasps.qualities.max() <= 0.2
    for direction in np.concatenate([np.eye(3), -np.eye(3)]):
        assert towards(grasps, direction, 0.85) >= 15


def test_near_the_centre_of_mass_first():
    bar = trimesh.creation.box((0.03, 0.03, 0.3))
    grasps = sample_grasps(bar, np.array([0, 0, 0.1]), np.random.default_rng(0), count=100)
    along = grasps.tcp_in_object[:, 2, 3]
    assert abs(along[0] - 0.1) <= 0.04
    assert along.min() < -0.1 and along.max() > 0.1  # the rest reach both ends
