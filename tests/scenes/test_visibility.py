"""p_vis: areas computed by hand, and general laws."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.scenes.visibility import MeshScene, PinholeCamera, load_visual_mesh, top_down_camera

PLATE = trimesh.creation.box((0.1, 0.1, 0.002))
HIGH = PinholeCamera(top_down_camera(np.zeros(2), 9.5).pose, 256, 256, 0.03)  # nearly parallel rays


def at(*position: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = position
    return pose


def shares(*poses, camera=HIGH) -> np.ndarray:
    return MeshScene([PLATE] * len(poses), np.asarray(poses)).visible_fractions(camera)


def test_visible_fractions_by_hand():
    assert shares(at(0, 0, 0), at(0.05, 0, 0.01)) == pytest.approx([0.5, 1.0], abs=0.01)
    assert shares(at(0, 0, 0), at(0, 0.075, 0.01)) == pytest.approx([0.75, 1.0], abs=0.01)
    assert shares(at(0, 0.075, 0.01), at(0, 0, 0)) == pytest.approx([1.0, 0.75], abs=0.01)
    assert np.isnan(shares(at(5, 0, 0))).all()
    assert np.isnan(shares(at(0, 0, 11))).all()  # behind the camera
    assert shares().shape == (0,)


def test_visible_fraction_depends_on_the_camera_position():
    wall = trimesh.creation.box((0.01, 1.0, 1.0))
    scenery = MeshScene([PLATE, wall], np.stack([at(0, 0, 0), at(0.3, 0, 0)]))
    behind, above = np.eye(4), top_down_camera(np.zeros(2), 0.0)
    behind[:3, :3] = np.diag([-1.0, -1.0, 1.0])  # looks along -x, at the wall
    behind[:3, 3] = 1.0, 0, 0.2
    assert scenery.visible_fractions(PinholeCamera(behind, 128, 128))[0] == 0
    assert scenery.visible_fractions(above)[0] == 1


def test_pixels_are_at_the_projected_positions():
    camera = PinholeCamera(np.eye(4), 100, 80, np.pi / 2)  # looks along x: y is left, z up
    ids = MeshScene([trimesh.creation.box((0.1, 0.1, 0.1))], at(2.0, 0.5, 0.5)[None]).render_segmentation(camera)[0]
    rows, columns = np.nonzero(ids == 0)
    # 2 m ahead, 0.5 left, 0.5 up; focal length 40: 10 pixels left of and above the middle
    assert columns.mean() + 0.5 == pytest.approx(50 - 10, abs=0.6)
    assert rows.mean() + 0.5 == pytest.approx(40 - 10, abs=0.6)


def test_the_selection_camera_looks_down_with_the_worlds_x_up():
    camera = top_down_camera(np.array([0.3, 0.2]), 0.6)
    np.testing.assert_allclose(camera.pose[:3, 3], [0.3, 0.2, 1.1])
    np.testing.assert_allclose(camera.pose[:3, 0], [0, 0, -1])
    assert camera.focal_length == pytest.approx(256)
    scenery = MeshScene([PLATE] * 3, np.stack([at(0, 0, 0), at(0, 0.075, 0.01), at(0.05, 0, 0.02)]))
    ids = scenery.render_segmentation(HIGH)[0]
    # 0.1 m are 85 pixels; the world's x is up, y left: the third plate covers part of the others
    assert [ids[148, 148], ids[148, 64], ids[85, 128], ids[2, 2]] == [0, 1, 2, -1]


def test_changed_mesh_file_is_loaded_again():
    plate = PLATE.copy()
    before = MeshScene([plate], np.eye(4)[None]).render_segmentation(HIGH)[1][0]
    plate.apply_scale(0.5)
    assert MeshScene([plate], np.eye(4)[None]).render_segmentation(HIGH)[1][0] == pytest.approx(before / 4, rel=0.05)


def test_meshes_are_in_the_assets_frame():
    asset = load_pack("builtin").objects["drink"]
    hulls = np.concatenate(asset.hulls)
    np.testing.assert_allclose(load_visual_mesh(asset).bounds, [hulls.min(axis=0), hulls.max(axis=0)], atol=0.003)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_visibility_laws(seed):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.random(5, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform([-0.1, -0.1, 0], [0.1, 0.1, 0.2], (5, 3))
    camera = top_down_camera(np.zeros(2), 0.0, size=128)
    few, more = shares(*poses[:4], camera=camera), shares(*poses, camera=camera)[:4]
    seen = ~np.isnan(few)  # a plate seen edge-on is not visible
    np.testing.assert_array_equal(seen, ~np.isnan(more))
    assert ((few[seen] >= 0) & (few[seen] <= 1)).all()
    assert (more[seen] <= few[seen]).all()  # more occluders do not increase p_vis
    alone = [MeshScene([PLATE], pose[None]).render_segmentation(camera) for pose in poses]
    ids, full = MeshScene([PLATE] * 5, poses).render_segmentation(camera)
    np.testing.assert_array_equal(full, [one[1][0] for one in alone])
    for i, (one, _) in enumerate(alone):
        assert (one[ids == i] == 0).all()  # each pixel shows one of those that would fill it
    other_way = MeshScene([PLATE] * 5, poses[::-1]).render_segmentation(camera)[0]  # the order of meshes doesn't matter
    np.testing.assert_array_equal(np.where(other_way >= 0, 4 - other_way, -1), ids)
