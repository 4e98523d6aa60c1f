from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from asset_tools.builtin.furniture import MAKERS
from asset_tools.builtin.furniture.room import make_room
from asset_tools.quality.furniture import examine_furniture
from robocas_ms3.assets.annotations import GRIPPER_BOXES

JOINTS = [("cabinet", f"{part}_{side}") for part in ("door", "drawer") for side in ("left", "right")]
JOINTS += [("container", "door"), ("refrigerator", "door"), ("refrigerator", "freezer_door")]


@cache
def made(name):
    return make_room(64) if name == "room" else MAKERS[name]()


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


@pytest.mark.parametrize("name, part", JOINTS)
def test_the_open_gripper_reaches_around_the_handle(name, part):
    """The boxes of hand and fingers are free, and the bar is between the fingers, as thick as it says."""
    handle = made(name).handles[part]
    tcp, own = pose(handle), bodies(made(name))[part]
    everything = [piece for pieces in bodies(made(name)).values() for piece in pieces]
    for low, high in GRIPPER_BOXES:
        for side in (1, -1):
            axes = [np.linspace(a, b, 1 + int((b - a) / 0.003)) for a, b in zip(low, high, strict=True)]
            points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3) * (1, side, 1)
            assert not within(everything, points @ tcp[:3, :3].T + tcp[:3, 3]).any()
    across = np.outer(handle.width / 2 * np.array([0, 0.98, -0.98, 1.02, -1.02]), (0, 1, 0))
    for along in (-0.01, 0, 0.01):  # m, all along the pads
        points = (across + (along, 0, 0)) @ tcp[:3, :3].T + tcp[:3, 3]
        assert within(own, points).tolist() == [True, True, True, False, False]


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
