"""Start and end of pushes, and placement of objects: known geometry, no simulator."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from robocas_ms3.core.poses import transform_points
from robocas_ms3.planning import pushes as pushing
from robocas_ms3.planning.skills.look import sample_views
from robocas_ms3.planning.skills.remove import compute_upright_rotation, find_free_places

SURFACE = 0.1  # height of the table, in the arm's base frame
TABLE = np.eye(4)
TABLE[:3, 3] = 0.6, 0, SURFACE
HALF = np.array([0.3, 0.5])


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], step: float = 0.005) -> np.ndarray:
    """Return points (P, 3) inside an axis-aligned box."""
    axes = [np.linspace(a, b, round((b - a) / step) + 1) for a, b in (x, y, z)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


OBSTACLE = box((0.57, 0.63), (0.07, 0.13), (0.1, 0.2))  # 6 cm wide around (0.6, 0.1), 10 cm high
TARGET = np.array([0.6, 0.0, 0.13])
NOTHING = np.zeros((0, 3))


def pushes(target=TARGET, others=NOTHING, points=OBSTACLE, half=HALF, fixed=NOTHING) -> list[pushing.Push]:
    return list(
        pushing.generate_push_candidates(np.random.default_rng(0), points, target, others, (TABLE, half), fixed)
    )


def test_push_of_an_object_above_the_target_is_towards_the_robot():
    above = np.array([0.6, 0.005, 0.2])
    angles = []
    for seed in range(40):
        x, y, z = pushing.compute_push_direction(np.random.default_rng(seed), above, np.array([0.6, 0, 0.1]))
        assert z == 0
        angles.append(np.rad2deg(np.arctan2(-y, -x)))
    assert -30.5 <= min(angles) < -15
    assert 15 < max(angles) <= 30.5


def test_first_push_has_the_direction_of_the_paper():
    push = pushes()[0]
    assert push.direction == pytest.approx([0, 1, 0])
    # 2 cm clear of the object's side at y = 0.07, at the target's height
    assert push.start[:3, 3] == pytest.approx([0.6, 0.07 - pushing.STAND_OFF - pushing.TOOL_RADIUS, 0.13])
    assert push.length == pytest.approx(pushing.STAND_OFF + 0.03 + 0.1)  # RoboCAS-v0's
    assert push.start[:3, 2] == pytest.approx([0, 0, -1])  # tool down
    assert push.end[:3, 3] - push.start[:3, 3] == pytest.approx(push.length * push.direction)
    for turn in (30.0, -30.0):
        found = pushing.generate_push_candidates(
            np.random.default_rng(0), OBSTACLE, TARGET, NOTHING, (TABLE, HALF), NOTHING, turn
        )
        first = next(found).direction
        assert np.rad2deg(np.arctan2(first[1], first[0])) == pytest.approx(90 + turn)


def test_tool_starts_at_free_positions_only():
    standing = box((0.58, 0.62), (0.0, 0.06), (0.1, 0.15))
    assert all(push.start[2, 3] > 0.15 for push in pushes(others=standing) if push.direction[1] > 0.99)
    wall = box((0.4, 0.8), (-0.1, 0.06), (0.1, 0.3))
    sideways = pushes(others=wall)
    assert sideways  # along the wall there is room
    assert all(abs(push.direction[1]) < 1e-9 for push in sideways)
    around = np.concatenate([wall, box((0.5, 0.56), (0, 0.2), (0.1, 0.3)), box((0.64, 0.7), (0, 0.2), (0.1, 0.3))])
    assert pushes(others=around) == []


@settings(max_examples=30, deadline=None)
@given(x=st.floats(0.4, 0.8), y=st.floats(-0.3, 0.3), seed=st.integers(0, 99))
def test_all_pushes_end_on_the_surface(x, y, seed):
    points = OBSTACLE - OBSTACLE.mean(axis=0) + [x, y, 0.15]
    rng = np.random.default_rng(seed)
    for push in pushing.generate_push_candidates(
        rng, points, np.array([0.6, 0.0, 0.12]), NOTHING, (TABLE, HALF), NOTHING
    ):
        moved = points + (push.length - pushing.STAND_OFF) * push.direction
        assert np.all(np.abs(moved[:, :2] - TABLE[:2, 3]) <= HALF - pushing.EDGE_MARGIN)
        assert push.start[2, 3] - pushing.TIP_BELOW_TCP >= SURFACE + pushing.TIP_CLEARANCE - 1e-9


def test_objects_are_not_pushed_against_walls():
    ahead = pushes()[0]
    assert ahead.direction == pytest.approx([0, 1, 0])
    end = 0.13 + ahead.length - pushing.STAND_OFF  # of the object's front
    wall = box((0.5, 0.7), (end + 0.01, end + 0.02), (0.1, 0.3))
    assert not any(push.direction @ [0, 1, 0] > 0.99 for push in pushes(fixed=wall))
    beyond = wall + [0, 0.02, 0]
    assert pushes(fixed=beyond)[0].direction == pytest.approx([0, 1, 0])
    above = wall + [0, 0, 0.11]
    assert pushes(fixed=above)[0].direction == pytest.approx([0, 1, 0])


def test_free_positions_are_on_the_surface_and_collision_free():
    held = box((0.5, 0.6), (0.0, 0.04), (0.4, 0.45))
    standing = box((0.55, 0.65), (-0.2, 0.2), (SURFACE, 0.2))
    motions = find_free_places(held, standing, TABLE, HALF)
    assert len(motions) > 20
    tree = KDTree(standing[:, :2])
    for motion in motions[:: len(motions) // 20]:
        placed = transform_points(motion, held)
        assert placed[:, 2].min() == pytest.approx(SURFACE + 0.012)
        assert np.all(np.abs(placed[:, :2] - TABLE[:2, 3]) <= HALF - 0.03 + 1e-9)
        assert tree.query(placed[:, :2])[0].min() >= 0.02
        assert motion[2, :3] == pytest.approx([0, 0, 1])  # it keeps standing as it was held
    full = box((0.3, 0.9), (-0.5, 0.5), (SURFACE, 0.2), step=0.02)
    assert len(find_free_places(held, full, TABLE, HALF)) == 0


def test_views_look_at_the_point_from_above():
    point = np.array([0.5, 0.1, 0.2])
    views = sample_views(np.random.default_rng(1), point, (0.4, 0.5), 200)
    line = point - views[:, :3, 3]
    distance = np.linalg.norm(line, axis=1)
    assert np.all((distance >= 0.4) & (distance <= 0.5))
    assert np.allclose(line / distance[:, None], views[:, :3, 0])  # x is forward
    elevation = np.rad2deg(np.arcsin(-line[:, 2] / distance))
    assert np.all((elevation >= 60 - 1e-6) & (elevation <= 90))


def test_views_from_the_front_are_within_the_given_angles():
    point, rng = np.array([0.5, 0.1, 0.2]), np.random.default_rng(1)
    views = sample_views(rng, point, (0.4, 0.5), 200, elevation_deg=(15, 55), azimuth=(-0.7, 0.7))
    forward = views[:, :3, 0]
    elevation, azimuth = np.rad2deg(np.arcsin(-forward[:, 2])), np.arctan2(forward[:, 1], forward[:, 0])
    assert elevation.min() >= 15 and elevation.max() <= 55 and np.abs(azimuth).max() <= 0.7
    assert elevation.min() < 20 and elevation.max() > 50 and azimuth.min() < -0.5 and azimuth.max() > 0.5


BRICK = np.array([[x, y, z] for x in (-0.01, 0.01) for y in (-0.02, 0.02) for z in (-0.05, 0.05)])


def corners(shift):
    """Return the corners of a box of 2 x 2 x 4 cm with its top shifted along x."""
    return np.array([[x + shift * z / 0.04, y, z] for x in (0, 0.02) for y in (0, 0.02) for z in (0, 0.04)])


@pytest.mark.parametrize("turned_deg", [(20, 0, 0), (0, -35, 0), (0, 0, 70)])
def test_tilted_object_is_rotated_upright_about_horizontal_axes(turned_deg):
    leant = Rotation.from_euler("xyz", turned_deg, degrees=True)
    expected = leant.inv().as_matrix() if turned_deg[2] == 0 else np.eye(3)
    turn = compute_upright_rotation(leant.apply(BRICK), np.zeros(3))
    np.testing.assert_allclose(turn[:3, :3], expected, atol=1e-9)
    np.testing.assert_array_equal(turn[:3, 3], 0)


def test_object_tilted_beyond_45_degrees_is_rotated_to_the_next_side():
    leant = Rotation.from_euler("x", 50, degrees=True)
    turn = compute_upright_rotation(leant.apply(BRICK), np.zeros(3))
    np.testing.assert_allclose(turn[:3, :3], Rotation.from_euler("x", 40, degrees=True).as_matrix(), atol=1e-9)


def test_face_not_below_the_centre_of_mass_is_unstable():
    # its foot reaches to x = 2 cm, its middle is at 1.5 cm, then at 2.5 cm: it falls onto the side (3, 4) cm long
    np.testing.assert_array_equal(compute_upright_rotation(corners(0.01), corners(0.01).mean(axis=0)), np.eye(4))
    turn = compute_upright_rotation(corners(0.03), corners(0.03).mean(axis=0))
    expected = Rotation.from_rotvec([0, np.arccos(0.6), 0]).as_matrix()
    np.testing.assert_allclose(turn[:3, :3], expected, atol=1e-9)
