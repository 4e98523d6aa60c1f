"""p_vis: areas worked out by hand, and laws."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.scenes.visibility import PinholeCamera, Scenery, object_mesh, top_down_camera, visible_shares

PLATE = trimesh.creation.box((0.1, 0.1, 0.002))
HIGH = top_down_camera(np.zeros(2), 0.0, height=10.0, size=256, fov=0.03)  # nearly parallel rays


def at(*position: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = position
    return pose


def test_a_plate_half_covered_is_half_visible():
    shares = visible_shares(HIGH, [PLATE], at(0, 0, 0)[None], occluders=[(PLATE, at(0.05, 0, 0.01))])
    assert shares == pytest.approx([0.5], abs=0.01)


def test_of_two_plates_the_upper_is_whole():
    poses = np.stack([at(0, 0, 0), at(0, 0.075, 0.01)])
    assert visible_shares(HIGH, [PLATE, PLATE], poses) == pytest.approx([0.75, 1.0], abs=0.01)
    assert visible_shares(HIGH, [PLATE, PLATE], poses[::-1]) == pytest.approx([1.0, 0.75], abs=0.01)


def test_what_the_camera_cannot_see_has_no_share():
    assert np.isnan(visible_shares(HIGH, [PLATE], at(5, 0, 0)[None])).all()
    assert np.isnan(visible_shares(HIGH, [PLATE], at(0, 0, 11)[None])).all()  # behind it


def test_pixels_are_where_the_camera_sees_things():
    camera = PinholeCamera(np.eye(4), 100, 80, np.pi / 2)  # looks along x: y is left, z up
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    ids = Scenery([box], at(2.0, 0.5, 0.5)[None]).hit_ids(camera)
    rows, columns = np.nonzero(ids == 0)
    # 2 m ahead, 0.5 left, 0.5 up; focal length 40: 10 pixels left of and above the middle
    assert columns.mean() + 0.5 == pytest.approx(50 - 10, abs=0.6)
    assert rows.mean() + 0.5 == pytest.approx(40 - 10, abs=0.6)


def test_the_selection_camera_looks_down_with_the_worlds_x_up():
    camera = top_down_camera(np.array([0.3, 0.2]), 0.6)
    np.testing.assert_allclose(camera.pose[:3, 3], [0.3, 0.2, 1.1])
    np.testing.assert_allclose(camera.pose[:3, 0], [0, 0, -1])
    assert np.linalg.det(camera.pose[:3, :3]) == pytest.approx(1)
    assert camera.focal_length == pytest.approx(256)


def test_pixels_name_what_they_show():
    ids = Scenery([PLATE, PLATE], np.stack([at(0, 0, 0), at(0, 0.075, 0.01)]), [(PLATE, at(0.05, 0, 0.02))]).hit_ids(
        HIGH
    )
    # 0.1 m are 85 pixels; the world's x is up, y left: the occluder (2) covers the upper halves of both plates in part
    assert ids[128 + 20, 128 + 20] == 0
    assert ids[128 + 20, 128 - 64] == 1
    assert ids[128 - 43, 128] == 2
    assert ids[2, 2] == -1


def test_an_empty_scene_shows_nothing():
    nothing = Scenery([], np.zeros((0, 4, 4)))
    assert (nothing.hit_ids(HIGH) == -1).all()
    assert nothing.visible_shares(HIGH).shape == (0,)


def test_the_hidden_share_depends_on_where_the_camera_is():
    wall = trimesh.creation.box((0.01, 1.0, 1.0))
    scenery = Scenery([PLATE, wall], np.stack([at(0, 0, 0), at(0.3, 0, 0)]))
    behind, above = np.eye(4), top_down_camera(np.zeros(2), 0.0)
    behind[:3, :3] = np.diag([-1.0, -1.0, 1.0])  # looks along -x, at the wall
    behind[:3, 3] = 1.0, 0, 0.2
    assert scenery.visible_share(PinholeCamera(behind, 128, 128), 0) == 0
    assert scenery.visible_share(above, 0) == 1


def test_a_mesh_that_is_changed_is_seen_as_it_is_now():
    plate = PLATE.copy()
    before = Scenery([plate], np.eye(4)[None]).visible_pixels(HIGH)[1][0]
    plate.apply_scale(0.5)
    assert Scenery([plate], np.eye(4)[None]).visible_pixels(HIGH)[1][0] == pytest.approx(before / 4, rel=0.05)


def test_meshes_are_in_the_assets_frame():
    asset = load_pack("builtin").objects["drink"]
    hulls = np.concatenate(asset.hulls)
    np.testing.assert_allclose(object_mesh(asset).bounds, [hulls.min(axis=0), hulls.max(axis=0)], atol=0.003)
    assert object_mesh(asset) is object_mesh(asset)


POSES = st.integers(0, 10_000).map(lambda seed: random_poses(np.random.default_rng(seed), 5))


def random_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform([-0.1, -0.1, 0], [0.1, 0.1, 0.2], (count, 3))
    return poses


@settings(max_examples=20, deadline=None)
@given(poses=POSES)
def test_shares_are_shares_and_more_cover_shows_no_more(poses):
    camera = top_down_camera(np.zeros(2), 0.0, size=128)
    few = visible_shares(camera, [PLATE] * 4, poses[:4])
    more = visible_shares(camera, [PLATE] * 4, poses[:4], occluders=[(PLATE, poses[4])])
    seen = ~np.isnan(few)  # a plate on edge is not seen at all
    np.testing.assert_array_equal(seen, ~np.isnan(more))
    assert ((few[seen] >= 0) & (few[seen] <= 1)).all()
    assert (more[seen] <= few[seen]).all()


@settings(max_examples=20, deadline=None)
@given(poses=POSES)
def test_what_stands_alone_is_whole(poses):
    camera = top_down_camera(np.zeros(2), 0.0, size=128)
    for pose in poses:
        assert visible_shares(camera, [PLATE], pose[None]) == 1


@settings(max_examples=10, deadline=None)
@given(poses=POSES)
def test_each_pixel_shows_the_nearest_of_those_that_would_fill_it(poses):
    camera = top_down_camera(np.zeros(2), 0.0, size=128)
    scenery = Scenery([PLATE] * 5, poses)
    ids, full = scenery.hit_ids(camera), np.stack([scenery.full_mask(camera, i) for i in range(5)])
    np.testing.assert_array_equal(ids >= 0, full.any(axis=0))
    for i in range(5):
        assert full[i][ids == i].all()
    other_way = Scenery([PLATE] * 5, poses[::-1]).hit_ids(camera)  # the order of meshes doesn't matter
    np.testing.assert_array_equal(np.where(other_way >= 0, 4 - other_way, -1), ids)
    np.testing.assert_array_equal(scenery.visible_pixels(camera)[1], full.sum(axis=(1, 2)))
