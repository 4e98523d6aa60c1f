import numpy as np
import pytest
import trimesh
from sapien import physx

from asset_tools.quality import drops
from asset_tools.quality.drops import run_drop_test
from asset_tools.resting_poses import find_resting_poses
from robocas_ms3.assets.physics import RigidBody

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def listed(solid):
    return find_resting_poses(solid).poses


def standing(height):
    """The pose of an upright body whose origin is so high above the plane."""
    pose = np.eye(4)
    pose[2, 3] = height
    return pose


def can(radius, height, sections=24):
    mesh = trimesh.creation.cylinder(radius, height, sections=sections)
    across = 0.2 / 12 * (3 * radius**2 + height**2)
    inertia = np.array([across, across, 0.1 * radius**2])
    return RigidBody([np.asarray(mesh.vertices)], 0.2, np.zeros(3), inertia, IDENTITY)


def test_a_box_comes_to_rest_on_its_faces(block):
    solid = block(0.05, 0.08, 0.12)
    poses = listed(solid)
    report = run_drop_test(solid, poses)
    assert report.good.all() and not report.rolling.any()
    # it falls for sqrt(2 * 0.05 / 9.81) = 0.1 s, and topples
    assert report.rest_times.min() > 0.1 and report.rest_times.max() < 1.5
    assert report.penetrations.max() < 0.001
    assert report.jitters.max() < drops.REST_ENERGY * 0.2
    # the axis that points up at the end is the same as in the pose it was matched with
    for end, match in zip(report.ends, report.matches, strict=True):
        assert np.argmax(np.abs(end[2, :3])) == np.argmax(np.abs(poses[match, 2, :3]))


def test_a_pose_listed_at_the_wrong_height_or_tilt_matches_nothing(block):
    cube = block(0.06, 0.06, 0.06)
    assert run_drop_test(cube, standing(0.03)[None]).good.all()  # all six faces are alike
    assert not run_drop_test(cube, standing(0.04)[None]).good.any()
    tilted = standing(0.03)
    tilted[:3, :3] = trimesh.transformations.rotation_matrix(np.radians(15), [1, 0, 0])[:3, :3]
    assert not run_drop_test(cube, tilted[None]).good.any()


def test_a_can_may_roll_but_not_rock():
    solid = can(0.033, 0.1, sections=40)
    lying = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    lying[2, 3] = 0.033
    report = run_drop_test(solid, np.array([standing(0.05), lying]))
    assert report.good.mean() >= 0.9
    assert report.rolling.any()
    assert not report.rolling[report.matches == 0].any()
    assert run_drop_test(solid, standing(0.05)[None]).good.mean() < 0.6  # lying is not a listed pose


def test_a_trembling_object_is_never_at_rest(block, monkeypatch):
    solid = block(0.05, 0.08, 0.12)
    energy = drops._energy
    calls = iter(range(10**6))
    monkeypatch.setattr(drops, "_energy", lambda *a: energy(*a) + 1e-3 * (next(calls) // 20 % 40 == 0))
    report = run_drop_test(solid, listed(solid))  # a jerk of 1 mJ, or 10 cm/s, every 0.4 s
    assert not report.good.any()
    assert report.rest_times.min() > drops.TIME_LIMIT
    assert report.jitters.min() >= 1e-3


def test_drops_are_deterministic_and_restore_the_engine_settings(block):
    solid = block(0.05, 0.08, 0.12)
    physx.set_shape_config(contact_offset=0.0123)
    try:
        first, second = run_drop_test(solid, listed(solid)), run_drop_test(solid, listed(solid))
        assert physx.get_shape_config().contact_offset == pytest.approx(0.0123)
    finally:
        physx.set_shape_config(contact_offset=0.01)
    for name in ("ends", "rest_times", "matches", "penetrations", "jitters"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    other = run_drop_test(solid, listed(solid), seed=1)
    assert np.abs(other.ends - first.ends).max() > 0.01


def test_an_unlisted_face_is_noticed(block):
    solid = block(0.05, 0.08, 0.12)
    everywhere = run_drop_test(solid, listed(solid))
    edgewise = np.array([pose for pose in listed(solid) if abs(pose[2, 1]) > 0.9])  # y up: the middle pair of faces
    report = run_drop_test(solid, edgewise)
    up = np.argmax(np.abs(everywhere.ends[:, 2, :3]), axis=1)
    np.testing.assert_array_equal(report.good, up == 1)
    assert 0 < report.good.sum() < 20
