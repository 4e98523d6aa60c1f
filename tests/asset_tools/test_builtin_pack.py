import hashlib

import numpy as np
import pytest
import sapien
import trimesh
from sapien import physx

from asset_tools.builtin.build import MAKERS, build_asset, main
from asset_tools.builtin.objects import SPECS
from robocas_ms3.assets.pack import load_pack

DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def pack():
    return load_pack("builtin")


def test_ships_with_everything(pack):
    assert set(pack.objects) == {spec.id for spec in SPECS}
    assert set(pack.furniture) == set(MAKERS)
    assert sum(path.stat().st_size for path in pack.root.rglob("*")) < 8e6


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.id)
def test_shipped_object_is_what_the_table_says(pack, spec):
    loaded = pack.objects[spec.id]
    asset = loaded.asset
    np.testing.assert_allclose(asset.extents, spec.size, atol=1e-4)
    assert (asset.name, asset.category, asset.mass) == (spec.name, spec.category, spec.mass)
    assert " " in asset.name or "_" not in asset.id
    points = np.concatenate(loaded.hulls)
    np.testing.assert_allclose(
        [points.min(0), points.max(0)], [-np.array(spec.size) / 2, np.array(spec.size) / 2], atol=2e-3
    )
    assert asset.hull_count <= 24 and max(len(hull) for hull in loaded.hulls) <= 64
    assert asset.volume_iou >= 0.88
    assert asset.grasp_count >= 50


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.id)
def test_can_be_grasped_from_above_in_every_stable_pose(pack, spec):
    annotations = pack.objects[spec.id].annotations
    approach_in_object = annotations.grasps_tcp_in_object[:, :3, 2]
    for pose in annotations.resting_poses:
        steep = approach_in_object @ pose[:3, :3].T @ DOWN > np.cos(np.deg2rad(60))
        assert steep.sum() >= 20


@pytest.mark.parametrize("name", ["tomato_soup_can", "banana", "mug", "table", "basket", "room"])
def test_visual_is_textured_and_smooth(pack, name):
    loaded = pack.objects.get(name) or pack.furniture[name]
    (mesh,) = trimesh.load_scene(loaded.visual_path, process=False).geometry.values()
    image = mesh.visual.material.baseColorTexture
    assert max(image.size) <= (512 if name in pack.objects else 1024)
    assert b"image/jpeg" in loaded.visual_path.read_bytes()
    assert mesh.visual.uv.min() >= 0 and mesh.visual.uv.max() <= 1
    assert np.asarray(image).std() > 10
    shape = next(s for s in SPECS if s.id == name).shape if name in pack.objects else None
    if shape is not None:  # the formula's own normals, without a seam where the texture meets itself
        expected = shape(next(s for s in SPECS if s.id == name).size)
        np.testing.assert_allclose(mesh.vertex_normals, expected.normals, atol=1e-3)


def sphere_dropped_into(loaded, start, radius):
    """Where a sphere comes to rest that is let go above a container held in place; container's frame, m."""
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    builder = scene.create_actor_builder()
    builder.add_multiple_convex_collisions_from_file(str(loaded.hulls_path))
    builder.build_kinematic("container")
    builder = scene.create_actor_builder()
    builder.add_sphere_collision(radius=radius)
    builder.initial_pose = sapien.Pose(start)
    ball = builder.build("ball")
    for _ in range(150):
        scene.step()
    return ball.pose.p


def test_mug_is_hollow(pack):
    end = sphere_dropped_into(pack.objects["mug"], [-0.015, 0.0, 0.08], 0.012)
    floor = -0.085 / 2 + 0.006
    assert end[2] == pytest.approx(floor + 0.012, abs=2e-3)
    assert np.linalg.norm(end[:2] - [-0.015, 0]) < 0.0375 - 0.004 - 0.012 + 2e-3


def test_mug_handle_is_open(pack):
    """A thin rod's way through the handle, along y, is free; straight through its grip it is not."""
    hulls = [trimesh.convex.convex_hull(hull) for hull in pack.objects["mug"].hulls]
    through = np.array([[x, y, 0.0] for x in (0.030, 0.034) for y in np.linspace(-0.02, 0.02, 9)])
    assert not any(hull.contains(through).any() for hull in hulls)
    assert any(hull.contains([[0.0465, 0, 0.003]]).any() for hull in hulls)


@pytest.mark.parametrize("x, y", [(0.0, 0.0), (0.09, -0.09), (-0.1, 0.05)])
def test_basket_is_hollow(pack, x, y):
    basket = pack.furniture["basket"]
    end = sphere_dropped_into(basket, [x, y, 0.2], 0.03)
    inner = basket.asset.inner
    assert end[2] == pytest.approx(inner.min[2] + 0.03, abs=2e-3)
    assert (np.abs(end[:2]) < inner.max[0]).all()


def test_basket_stands_by_itself(pack):
    basket = pack.furniture["basket"].asset
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    scene.add_ground(0, render=False)
    builder = scene.create_actor_builder()
    builder.add_multiple_convex_collisions_from_file(str(pack.furniture["basket"].hulls_path))
    builder.set_mass_and_inertia(basket.mass, sapien.Pose(basket.center_of_mass), np.array(basket.inertia))
    builder.initial_pose = sapien.Pose([0, 0, basket.origin_height])
    body = builder.build("basket")
    for _ in range(100):
        scene.step()
    assert np.abs(body.pose.p - [0, 0, 0.096]).max() < 1e-3
    assert abs(body.pose.q[0]) > 0.99999


@pytest.mark.slow
def test_same_bytes_twice(tmp_path):
    def hashes(folder):
        build_asset("soap_box", folder)
        build_asset("basket", folder)
        return {
            str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*.*")
        }

    first = hashes(tmp_path / "a")
    assert len(first) == 5 and first == hashes(tmp_path / "b")


@pytest.mark.slow
def test_main_writes_a_pack_that_loads(tmp_path):
    main(tmp_path / "small", jobs=1, ids=["toothpaste_box", "table"])
    small = load_pack(tmp_path / "small")
    assert set(small.objects) == {"toothpaste_box"} and set(small.furniture) == {"table"}
    assert small.furniture["table"].asset.surfaces["top"].z == 0.61
