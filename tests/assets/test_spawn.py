import numpy as np
import pytest
import sapien
import torch
from asset_entries import furniture_asset
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.envs.utils.system.backend import parse_sim_and_render_backend
from mani_skill.utils.structs import Actor, Articulation
from sapien.physx import PhysxCollisionShapeBox, PhysxCollisionShapeConvexMesh, PhysxMaterial

from robocas_ms3.assets.hulls import write_hulls
from robocas_ms3.assets.manifest import Joint, Link
from robocas_ms3.assets.pack import BodyFiles, LoadedFurniture
from robocas_ms3.assets.physics import load_shapes
from robocas_ms3.assets.spawn import spawn, spawn_articulation
from robocas_ms3.core.errors import AssetError

DRAWER = Joint(name="slide", kind="prismatic", axis=(1, 0, 0), limits=(0, 0.3), friction=0.05, damping=2.0)


def box(low, high):
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


@pytest.fixture
def cabinet(tmp_path):
    """A board with a drawer on top, 0.2 m square; the drawer can slide out along x."""
    write_hulls(tmp_path / "hulls.obj", [box((0, 0, 0), (0.2, 0.2, 0.02))])
    (tmp_path / "links" / "drawer").mkdir(parents=True)
    write_hulls(tmp_path / "links" / "drawer" / "hulls.obj", [box((0, 0, 0.03), (0.2, 0.2, 0.1))])
    link = Link(name="drawer", joint=DRAWER, mass=1.5, center_of_mass=(0.1, 0.1, 0.065), inertia=(0.006, 0.006, 0.01))
    asset = furniture_asset("cabinet", extents=(0.2, 0.2, 0.1), links=(link,))
    return LoadedFurniture(tmp_path, asset=asset, links={"drawer": BodyFiles(tmp_path / "links" / "drawer")})


@pytest.fixture
def scene():
    sub_scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    backend = parse_sim_and_render_backend("physx_cpu", "none")
    return ManiSkillScene([sub_scene], device=torch.device("cpu"), backend=backend)


def test_a_drawer_slides_along_its_axis_and_no_farther_than_its_limit(scene, cabinet):
    pose = sapien.Pose([1, 0, 0.5], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # turned: its x is the world's y
    built = spawn_articulation(scene, cabinet, name="cabinet", pose=pose)
    assert isinstance(built, Articulation)
    (joint,) = built.active_joints
    assert joint.friction.tolist() == pytest.approx([0.05]) and joint.damping.tolist() == pytest.approx([2.0])
    body = built.links_map["drawer"]._bodies[0]
    assert body.mass == pytest.approx(1.5) and len(body.collision_shapes) == 1
    np.testing.assert_allclose(body.inertia, [0.006, 0.006, 0.01], rtol=1e-6)
    np.testing.assert_allclose(body.cmass_local_pose.p, [0.1, 0.1, 0.065], rtol=1e-6)
    for _ in range(100):
        body.add_force_at_point([0, 6.0, 0], body.entity_pose.p + [0, 0, 0.05])
        scene.sub_scenes[0].step()
    np.testing.assert_allclose(built.qpos.numpy(), [[0.3]], atol=5e-3)
    np.testing.assert_allclose(built.links_map["drawer"].pose.p[0].numpy(), [1, 0.3, 0.5], atol=5e-3)
    np.testing.assert_allclose(built.links_map["body"].pose.p[0].numpy(), [1, 0, 0.5], atol=1e-6)


def test_surface_points_follow_the_joint(cabinet):
    closed, pulled = cabinet.all_surface_points({}), cabinet.all_surface_points({"slide": 0.3})
    assert closed[:, 0].max() == pytest.approx(0.2) and pulled[:, 0].max() == pytest.approx(0.5)
    assert len(closed) == len(pulled)
    np.testing.assert_allclose(pulled[:, 2].max(), 0.1)


def test_furniture_without_moving_parts_is_a_static_actor(scene, cabinet):
    plain = LoadedFurniture(cabinet.folder, asset=cabinet.asset.model_copy(update={"links": ()}))
    built = spawn(scene, plain, name="board", pose=sapien.Pose())
    assert isinstance(built, Actor) and built.px_body_type == "static"


def test_box_hulls_become_boxes_at_their_poses(scene, tmp_path):
    wedge = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    write_hulls(tmp_path / "hulls.obj", [wedge, box((0.2, 0, 0), (0.3, 0.4, 0.6)), wedge + [0.5, 0, 0]])
    first, second, third = load_shapes(BodyFiles(tmp_path), PhysxMaterial(0.5, 0.5, 0.0))
    assert isinstance(second, PhysxCollisionShapeBox)
    np.testing.assert_allclose(second.half_size, [0.05, 0.2, 0.3], atol=1e-7)
    np.testing.assert_allclose(second.local_pose.p, [0.25, 0.2, 0.3], atol=1e-7)
    for shape, shift in ((first, 0.0), (third, 0.5)):
        assert isinstance(shape, PhysxCollisionShapeConvexMesh)
        np.testing.assert_allclose(shape.vertices.min(axis=0), [shift, 0, 0], atol=1e-6)
        np.testing.assert_allclose(shape.vertices.max(axis=0), [shift + 0.1, 0.1, 0.1], atol=1e-6)


def test_an_unknown_finish_is_named(cabinet):
    asset = cabinet.asset.model_copy(update={"finishes": {"wall": ("plaster", "brick")}})
    room = LoadedFurniture(cabinet.folder, asset=asset)
    assert room.finish_path("wall", "brick").name == "wall_brick.glb"
    with pytest.raises(
        AssetError, match=r"cabinet: no such finish of 'wall' \(expected one of plaster, brick, found gold\)"
    ):
        room.finish_path("wall", "gold")
