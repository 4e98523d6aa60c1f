"""p_vis: areas worked out by hand, laws, and SAPIEN's own segmentation."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

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


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_shares_are_shares_and_more_cover_shows_no_more(seed):
    rng = np.random.default_rng(seed)
    poses = np.stack([at(*p) for p in rng.uniform([-0.1, -0.1, 0], [0.1, 0.1, 0.2], (4, 3))])
    camera = top_down_camera(np.zeros(2), 0.0, size=128)
    few = visible_shares(camera, [PLATE] * 3, poses[:3])
    more = visible_shares(camera, [PLATE] * 3, poses[:3], occluders=[(PLATE, poses[3])])
    assert ((few >= 0) & (few <= 1)).all()
    assert (more <= few + 1e-12).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_agrees_with_sapiens_segmentation(seed, needs_renderer):
    import sapien

    pack = load_pack("builtin")
    rng = np.random.default_rng(seed)
    assets = [pack.objects[i] for i in rng.choice(sorted(pack.objects), 8, replace=False)]
    poses = np.stack([at(*p) for p in rng.uniform([-0.1, -0.1, 0.0], [0.1, 0.1, 0.15], (8, 3))])
    camera = top_down_camera(np.zeros(2), 0.0, height=0.35, size=256)

    scene = sapien.Scene()
    scene.set_ambient_light([1, 1, 1])
    actors = []
    for asset, pose in zip(assets, poses, strict=True):
        builder = scene.create_actor_builder()
        builder.add_visual_from_file(str(asset.visual("fast")))
        builder.initial_pose = sapien.Pose(pose)
        actors.append(builder.build_kinematic())
    eye = scene.add_camera("eye", 256, 256, np.pi / 2, 0.01, 5)
    eye.entity.set_pose(sapien.Pose(camera.pose))

    def areas() -> np.ndarray:
        scene.update_render()
        eye.take_picture()
        ids = eye.get_picture("Segmentation")[..., 1]
        return np.array([(ids == actor.per_scene_id).sum() for actor in actors])

    visible = areas()
    full = []
    for actor, pose in zip(actors, poses, strict=True):
        for other in actors:
            other.set_pose(sapien.Pose([0, 0, -50]))
        actor.set_pose(sapien.Pose(pose))
        full.append(areas()[actors.index(actor)])
    shares = visible_shares(camera, [object_mesh(asset) for asset in assets], poses)
    difference = np.abs(shares - visible / np.array(full))
    assert min(full) > 200
    assert difference.max() <= 0.02
    assert shares.min() < 0.8  # something is hidden
