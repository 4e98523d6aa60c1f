from functools import cache

import numpy as np
import pytest
import sapien
import trimesh
from sapien import physx
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from asset_tools.builtin.furniture import MAKERS
from asset_tools.builtin.furniture.base import block
from asset_tools.builtin.furniture.room import room
from asset_tools.inertia import piece_inertia
from asset_tools.quality.furniture import examine_furniture
from robocas_ms3.assets.annotations import GRIPPER_BOXES
from robocas_ms3.assets.hulls import write_hulls
from robocas_ms3.assets.kinematics import joint_frame

JOINTS = [("cabinet", f"{part}_{side}") for part in ("door", "drawer") for side in ("left", "right")]
JOINTS += [("container", "door"), ("refrigerator", "door"), ("refrigerator", "freezer_door")]


@cache
def made(name):
    return room(64) if name == "room" else MAKERS[name]()


def bodies(source):
    return {"": source.pieces} | {link.name: link.pieces for link in source.links}


def pose(handle):
    result = np.eye(4)
    w, x, y, z = handle.wxyz
    result[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    result[:3, 3] = handle.position
    return result


def within(pieces, points):
    """Which of the points (n, 3) lie in one of the convex pieces."""
    planes = [ConvexHull(piece).equations for piece in pieces]
    return np.any([(points @ p[:, :3].T + p[:, 3] <= 0).all(axis=1) for p in planes], axis=0)


@pytest.mark.parametrize("name", MAKERS)
def test_meshes_and_pieces(name):
    source = made(name)
    meshes = [source.mesh, *(link.mesh for link in source.links)]
    assert sum(len(mesh.faces) for mesh in meshes) <= 1500
    for mesh in meshes:
        assert mesh.visual.uv.min() >= 0 and mesh.visual.uv.max() <= 1
        assert max(mesh.visual.material.baseColorTexture.size) <= 1024
        corners = mesh.vertices[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        large = np.linalg.norm(normals, axis=1) > 1e-9
        assert (np.einsum("fi,fci->fc", normals, mesh.vertex_normals[mesh.faces])[large] > 0).all()
    for pieces in bodies(source).values():
        for piece in pieces:
            hull = trimesh.convex.convex_hull(piece)
            assert len(hull.vertices) == len(piece) <= 64 and hull.volume > 0


@pytest.mark.parametrize("name", [name for name in MAKERS if name not in ("basket", "room")])
def test_joints_work_and_surfaces_hold(name):
    report = examine_furniture(made(name))
    assert [key for key, joint in report.joints.items() if not joint.works] == []
    assert [key for key, surface in report.surfaces.items() if not surface.holds] == []
    assert len(report.surfaces) >= 1


def articulation(source, folder):
    """The furniture in a scene of its own, and the names of its joints in the engine's order."""
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    builder = scene.create_articulation_builder()
    parts = {"": builder.create_link_builder()}
    parts[""].set_joint_properties("fixed", [], sapien.Pose(), sapien.Pose())
    for link in source.links:
        part = parts[link.name] = builder.create_link_builder(parts[link.parent])
        part.set_name(link.name)
        part.set_joint_name(link.name)
        frame = sapien.Pose(joint_frame(link.joint))
        part.set_joint_properties(link.joint.kind, [link.joint.limits], frame, frame, 0.0, link.joint.damping)
        center, inertia, axes = piece_inertia(link.pieces, link.mass)
        part.set_mass_and_inertia(link.mass, sapien.Pose(center, axes), inertia)
    for key, pieces in bodies(source).items():
        write_hulls(folder / f"{key}.obj", pieces)
        parts[key].add_multiple_convex_collisions_from_file(str(folder / f"{key}.obj"))
    built = builder.build()
    joints = {joint.name: joint for joint in built.active_joints}
    for link in source.links:
        joints[link.name].set_friction(link.joint.friction)
    return scene, built, [joint.name for joint in built.active_joints]


@pytest.mark.parametrize("name, part", JOINTS)
def test_ten_newtons_open_it_and_nothing_keeps_it_there(name, part, tmp_path):
    source = made(name)
    link = next(link for link in source.links if link.name == part)
    handle = source.handles[part]
    scene, built, order = articulation(source, tmp_path)
    body = next(candidate for candidate in built.links if candidate.name == part)
    index, limit = order.index(part), link.joint.limits[1]

    def pull(force, seconds):
        for _ in range(round(seconds / scene.timestep)):
            frame = body.entity.pose.to_transformation_matrix()
            moved = frame @ pose(handle)
            way = -moved[:3, 2]
            if link.joint.kind == "prismatic":
                way = np.array(link.joint.axis)
            body.add_force_at_point((force * way).astype(np.float32), moved[:3, 3].astype(np.float32))
            scene.step()
        return built.qpos[index]

    for _ in range(50):
        scene.step()
    np.testing.assert_allclose(built.qpos, 0, atol=1e-5)  # nothing pushes anything
    assert pull(1.0, 0.5) < 0.02 * limit  # a touch does not move it
    half = pull(10.0, 1.0)
    assert 0.05 * limit < half < 0.95 * limit
    pull(0.0, 0.5)
    left = built.qpos[index]
    pull(0.0, 1.0)
    assert abs(built.qpos[index] - left) < 1e-3 * limit
    assert pull(10.0, 4.0) == pytest.approx(limit, rel=0.01)
    assert pull(-10.0, 6.0) == pytest.approx(0, abs=0.01 * limit)
    others = np.delete(built.qpos, index)
    np.testing.assert_allclose(others, 0, atol=1e-3)


@pytest.mark.parametrize("name, part", JOINTS)
def test_the_open_gripper_reaches_around_the_handle(name, part):
    source = made(name)
    handle = source.handles[part]
    tcp = pose(handle)
    everything = [piece for pieces in bodies(source).values() for piece in pieces]
    for low, high in GRIPPER_BOXES:
        for side in (1, -1):
            box = block(np.array(low) * (1, side, 1), np.array(high) * (1, side, 1))
            axes = [np.arange(a, b + 0.003, 0.003).clip(a, b) for a, b in zip(box.min(0), box.max(0), strict=True)]
            points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3) @ tcp[:3, :3].T + tcp[:3, 3]
            assert not within(everything, points).any()
    # between the fingers is the bar, as thick as it says, and all along the pads
    own = bodies(source)[part]
    across = handle.width / 2 * np.array([0, 0.98, -0.98, 1.02, -1.02])
    for along in (-0.01, 0, 0.01):
        points = np.stack([np.full(5, along), across, np.zeros(5)], axis=1) @ tcp[:3, :3].T + tcp[:3, 3]
        assert within(own, points).tolist() == [True, True, True, False, False]
    # 35 mm of room behind it, as high as the fingers are wide
    behind = np.array(
        [[x, y, handle.width / 2 + d] for x in (-0.01, 0.01) for y in (-0.046, 0, 0.046) for d in (0.001, 0.035)]
    )
    assert not within(everything, behind @ tcp[:3, :3].T + tcp[:3, 3]).any()


@pytest.mark.parametrize("name, part", JOINTS)
def test_handles_open_what_they_belong_to(name, part):
    """Pulling back along the approach, or along the slide, opens."""
    source = made(name)
    link = next(link for link in source.links if link.name == part)
    handle = source.handles[part]
    back = -pose(handle)[:3, 2]
    np.testing.assert_allclose(back, (1, 0, 0), atol=1e-9)
    assert handle.link == part
    if link.joint.kind == "revolute":
        motion = np.cross(link.joint.axis, np.subtract(handle.position, link.joint.origin))
        assert motion @ back > 0.4  # m of way per rad: far from the hinge
    elif name == "cabinet":
        assert link.joint.axis == (1, 0, 0)
    else:
        assert link.joint.axis == (0, -1, 0)


def test_room_faces_inwards():
    source = made("room")
    assert len(source.finishes["wall"]) >= 6 and len(source.finishes["floor"]) >= 6
    meshes = [source.mesh, *source.finishes["wall"].values(), *source.finishes["floor"].values()]
    for mesh in meshes:
        to_center = np.array([0, 0, 2]) - mesh.triangles_center
        assert (np.einsum("ij,ij->i", to_center, mesh.face_normals) > 0).all()
    wall, floor = source.finishes["wall"]["brick"], source.finishes["floor"]["checker"]
    assert wall.area == pytest.approx(4 * 6 * 4) and floor.area == pytest.approx(6 * 6)
    inside = np.array([[0, 0, 0.001], [2.99, 0, 1], [0, -2.99, 1], [2.99, 2.99, 3.9]])
    outside = np.array([[0, 0, -0.001], [3.01, 0, 1], [0, -3.01, 1], [-3.01, 0, 1], [0, 3.01, 1]])
    assert not within(source.pieces, inside).any()
    assert within(source.pieces, outside).all()
