"""Resting poses of solids whose poses are known by hand."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from sapien import physx

from asset_tools.resting_poses import RestingPoses, find_resting_poses
from asset_tools.stability import compute_toppling_angle
from robocas_ms3.assets.physics import RigidBody
from robocas_ms3.core.errors import AssetError

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def body(*hulls, mass=0.3, center=(0, 0, 0), inertia=(4e-5, 4e-5, 4e-5)) -> RigidBody:
    return RigidBody(hulls, mass, np.array(center, float), np.array(inertia, float), IDENTITY)


def box_points(x: float, y: float, z: float) -> np.ndarray:
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return signs * np.array([x, y, z]) / 2


def box_inertia(mass: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    return mass / 12 * (y * y + z * z), mass / 12 * (x * x + z * z), mass / 12 * (x * x + y * y)


def solid(mesh: trimesh.Trimesh, mass: float = 0.3) -> RestingPoses:
    """Poses of the convex hull of a mesh, filled evenly."""
    hull = mesh.convex_hull
    hull.density = mass / hull.volume
    moments = np.linalg.eigvalsh(hull.moment_inertia)
    # principal axes do not matter for whether a thing stays: only the moments' size does
    result = find_resting_poses(body(np.asarray(hull.vertices), mass=mass, center=hull.center_mass, inertia=moments))
    check(result, np.asarray(hull.vertices), np.asarray(hull.center_mass))
    return result


def check(result: RestingPoses, vertices: np.ndarray, center: np.ndarray) -> None:
    """What every answer must hold: rigid poses on the plane, centred, probabilities that sum to one, no doubles."""
    assert result.probabilities.sum() == pytest.approx(1)
    assert (result.probabilities > 0).all()
    for pose in result.poses:
        rotation = pose[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(rotation) == pytest.approx(1)
        assert (vertices @ rotation.T + pose[:3, 3])[:, 2].min() == pytest.approx(0, abs=5e-4)
        np.testing.assert_allclose((rotation @ center + pose[:3, 3])[:2], 0, atol=1e-9)
    ups = result.poses[:, 2, :3]
    cosines = ups @ ups.T - 2 * np.eye(len(ups))
    assert cosines.max() < np.cos(np.radians(5))


def test_box_has_its_six_faces_and_prefers_the_largest() -> None:
    points = box_points(0.04, 0.06, 0.10)
    inertia = box_inertia(0.2, 0.04, 0.06, 0.10)
    result = find_resting_poses(body(points, mass=0.2, inertia=inertia))
    check(result, points, np.zeros(3))
    found = {
        tuple(np.round(pose[2, :3]).astype(int)): (p, pose[2, 3])
        for pose, p in zip(result.poses, result.probabilities, strict=True)
    }
    assert len(found) == 6
    half = np.array([0.02, 0.03, 0.05])
    for up, (probability, height) in found.items():
        axis = int(np.argmax(np.abs(up)))
        b, c = np.delete(half, axis)
        a = half[axis]
        # solid angle of a rectangle seen from above its middle, over the whole sphere
        share = 4 * np.arctan(b * c / (a * np.sqrt(a * a + b * b + c * c))) / (4 * np.pi)
        assert height == pytest.approx(half[axis], abs=2e-4)
        assert probability == pytest.approx(share, abs=1e-6)
    assert abs(result.poses[0, 2, 0]) == pytest.approx(1, abs=1e-4)  # on its 0.06 x 0.10 face
    assert result.poses[result.display_pose][2, 2] == pytest.approx(1, abs=1e-4)


def test_cylinder_stands_both_ways_and_lies() -> None:
    result = solid(trimesh.creation.cylinder(radius=0.03, height=0.08, sections=32))
    up = result.poses[:, 2, 2]
    # the engine thins the rims, so that on its side the cylinder leans by up to 0.4 deg
    standing, lying = np.abs(up) > 0.999, np.abs(up) < 0.01
    assert (standing | lying).all()
    assert sorted(np.sign(up[standing])) == [-1, 1]
    assert 1 <= lying.sum() <= 10
    # seen from the middle, each end is a cone of half angle atan(3 / 4): (1 - 0.8) / 2 of the sphere
    np.testing.assert_allclose(result.probabilities[standing], 0.1, atol=0.004)
    np.testing.assert_allclose(result.poses[standing, 2, 3], 0.04, atol=2e-4)
    np.testing.assert_allclose(result.poses[lying, 2, 3], 0.03, atol=5e-4)
    assert up[result.display_pose] > 0.999


def test_resting_poses_are_deterministic_and_restore_the_engine_settings() -> None:
    physx.set_shape_config(contact_offset=0.0123, rest_offset=0.0)
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.03)
    one, two = solid(mesh), solid(mesh)
    assert physx.get_shape_config().contact_offset == pytest.approx(0.0123)
    np.testing.assert_array_equal(one.poses, two.poses)
    np.testing.assert_array_equal(one.probabilities, two.probabilities)


def test_weight_outside_and_flat_hulls_are_refused() -> None:
    points = box_points(0.04, 0.06, 0.10)
    with pytest.raises(AssetError, match="outside the hulls"):
        find_resting_poses(body(points, center=(0.03, 0, 0)))
    flat = points * [1, 1, 0]
    with pytest.raises(AssetError, match="no volume"):
        find_resting_poses(body(flat))


def test_toppling_angle_of_a_box_is_known():
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-2, 2) for z in (-3, 3)], float)
    up = np.array([0, 0, 1.0])
    # 1 to the nearest edge, 3 high
    assert compute_toppling_angle(corners, np.zeros(3), up) == pytest.approx(np.degrees(np.arctan2(1, 3)))
    assert compute_toppling_angle(corners, np.array([0.9, 0, 0]), up) == pytest.approx(np.degrees(np.arctan2(0.1, 3)))
    assert compute_toppling_angle(corners, np.zeros(3), np.array([1, 0, 1]) / np.sqrt(2)) == 0  # on an edge


def test_a_body_that_only_rocks_is_put_down_on_its_blunt_edges_too() -> None:
    """A bar 70 mm wide whose broad sides are roofs 1.1 mm high: each half is 1.8 deg off, and lets go at 1.8 deg."""
    outline = [(0.035, 0.0229), (0, 0.024), (-0.035, 0.0229), (-0.035, -0.0229), (0, -0.024), (0.035, -0.0229)]
    points = np.array([(x, y, z) for x, z in outline for y in (-0.085, 0.085)])
    result = find_resting_poses(body(points, inertia=box_inertia(0.3, 0.07, 0.17, 0.047)))
    ups = result.poses[:, 2, :3]
    slant = np.arctan(0.0011 / 0.035)
    broad = ups[np.abs(ups[:, 2]) > 0.9]
    np.testing.assert_allclose(np.abs(broad), [(np.sin(slant), 0, np.cos(slant))] * 2, atol=1e-3)  # halves are merged
    assert broad[:, 2].min() < 0 < broad[:, 2].max()
    assert result.probabilities[np.abs(ups[:, 2]) > 0.9].sum() > 0.5


def test_box_with_its_weight_at_one_end_never_stands_on_a_slanted_far_end() -> None:
    # A bar along x, 0.2 long: its far end (x = 0.1) is cut so that the face's normal leans 45 deg, and its weight
    # sits at x = -0.08. From there the foot on the cut face's plane falls outside the bar.
    points = np.array(
        [(x, y, z) for y in (-0.03, 0.03) for x, z in ((-0.1, -0.03), (-0.1, 0.03), (0.1, -0.03), (0.04, 0.03))]
    )
    center = np.array([-0.08, 0.0, 0.0])
    result = find_resting_poses(body(points, center=center, inertia=(2e-4, 4e-4, 4e-4)))
    check(result, points, center)
    downs = -result.poses[:, 2, :3]
    assert (downs[:, 0] < 0.1).all()
    # the heavy end, near the weight, and the four sides hold
    assert len(downs) == 5
    assert downs[0] @ [-1, 0, 0] == pytest.approx(1, abs=1e-4)


def test_an_eccentric_centre_of_mass_changes_the_poses() -> None:
    points = box_points(0.05, 0.05, 0.05)
    low = find_resting_poses(body(points, mass=0.1, center=(0, 0, -0.02)))
    assert low.display_pose == 0
    # solid angle of the 0.05 m square seen from 5 mm above its middle
    assert low.probabilities[0] == pytest.approx(
        np.arctan(0.025**2 / (0.005 * np.sqrt(0.005**2 + 2 * 0.025**2))) / np.pi, abs=0.01
    )


def test_ball_gets_a_pose_that_stays() -> None:
    result = solid(trimesh.creation.icosphere(subdivisions=2, radius=0.035))
    assert 1 <= len(result.poses) <= 12
    np.testing.assert_allclose(result.poses[:, 2, 3], 0.035, atol=1.5e-3)


def test_an_object_of_two_pieces_stands_on_both() -> None:
    # A table of two legs: the convex hull bridges the gap, the pieces carry the weight
    legs = [box_points(0.02, 0.06, 0.05) + [side * 0.05, 0, 0] for side in (-1, 1)]
    result = find_resting_poses(body(*legs, mass=0.2, inertia=(1e-4, 6e-4, 6e-4)))
    check(result, np.concatenate(legs), np.zeros(3))
    assert len(result.poses) == 6


def test_a_pen_is_not_put_down_on_its_end(monkeypatch) -> None:
    """4 mm across and 15 cm long it lets go at 1.5 deg, and then it falls."""
    points = box_points(0.004, 0.004, 0.15)
    pen = body(points, mass=0.01, inertia=box_inertia(0.01, 0.004, 0.004, 0.15))
    monkeypatch.setattr("asset_tools.resting_poses.RAREST", 0.0)
    result = find_resting_poses(pen)
    assert np.abs(result.poses[:, 2, 2]).max() < 0.1
