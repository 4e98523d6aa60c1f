"""Collision geometry from a URDF: supported types, hulls of meshes, and errors."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pytest
import trimesh
from planning_scenes import REST, Checker, corners

from robocas_ms3.assets.annotations import GRIPPER_BOXES
from robocas_ms3.core.errors import RobotDescriptionError
from robocas_ms3.planning.collision import CollisionChecker
from robocas_ms3.planning.protocol import Obstacle, Shape
from robocas_ms3.planning.shapes import MARGIN
from robocas_ms3.robots.description import MOBILE_PANDA

HAND = "collision/hand.stl"
AHEAD = np.array([0, 0, 0.6])  # in the hand's frame, far from all links


@pytest.fixture
def files(panda_files, tmp_path) -> Path:
    """Return a copy of the arm's files that a test can change."""
    for path in (panda_files.arm_urdf, panda_files.arm_srdf):
        shutil.copyfile(path, tmp_path / path.name)
    shutil.copytree(panda_files.folder / "collision", tmp_path / "collision")
    return tmp_path


def load(files: Path) -> CollisionChecker:
    return CollisionChecker(files / "panda_arm.urdf", files / "panda_arm.srdf", MOBILE_PANDA)


def replace_hand(files: Path, shape: Element, *, position: str = "0 0 0.6", angles: str = "0 0 0") -> None:
    """Replace the collision geometry of the hand by a shape far ahead of it."""
    tree = ElementTree.parse(files / "panda_arm.urdf")
    hand = tree.find("link[@name='panda_hand']")
    for collision in hand.findall("collision"):
        hand.remove(collision)
    collision = SubElement(hand, "collision")
    SubElement(collision, "origin", xyz=position, rpy=angles)
    SubElement(collision, "geometry").append(shape)
    tree.write(files / "panda_arm.urdf")


def touches_cube(world: CollisionChecker, checker: Checker, position: np.ndarray) -> bool:
    """Return whether the hand touches a cube of 5.2 mm (margin included) at a position relative to ``AHEAD``."""
    pose = checker.link_pose("panda_hand", REST).copy()
    pose[:3, 3] += pose[:3, :3] @ (AHEAD + position)
    world.set_scene([Obstacle("cube", Shape((corners(*[0.0026 - MARGIN] * 3),)), pose)])
    return "cube" in world.find_collisions(REST, 0.0)


@pytest.mark.parametrize(
    ("tag", "size", "reach"),
    [
        ("sphere", {"radius": "0.2"}, (0.2, 0.2, 0.2)),
        ("cylinder", {"radius": "0.2", "length": "0.5"}, (0.2, 0.2, 0.25)),
        ("box", {"size": "0.4 0.3 0.5"}, (0.2, 0.15, 0.25)),
    ],
)
def test_primitives_have_the_size_of_the_urdf(files, checker, tag, size, reach):
    replace_hand(files, Element(tag, size))
    world = load(files)
    for axis, side in itertools.product(range(3), (-1, 1)):
        direction = side * np.eye(3)[axis]
        assert touches_cube(world, checker, direction * (reach[axis] + 0.002))
        assert not touches_cube(world, checker, direction * (reach[axis] + 0.004))
    edge = np.array([reach[0], reach[1], 0.0])  # round ones leave room next to the edge of the box around them
    assert touches_cube(world, checker, edge * 0.9) == (tag == "box")
    assert touches_cube(world, checker, edge * 0.69)


def test_geometries_are_placed_by_their_origin(files, checker):
    replace_hand(files, Element("box", size="0.02 0.02 0.4"), position="0.1 0 0.6", angles="0 1.5707963 0")
    world = load(files)
    assert touches_cube(world, checker, np.array([0.29, 0, 0]))
    assert not touches_cube(world, checker, np.array([0.1, 0, 0.1]))


def test_mesh_without_a_hull_file_is_replaced_by_its_convex_hull(files, checker):
    """Two balls 40 cm apart in one file are one convex hull."""
    balls = [trimesh.creation.icosphere(radius=0.05).apply_translation((x, 0, 0)) for x in (-0.2, 0.2)]
    trimesh.util.concatenate(balls).export(files / "collision" / "balls.stl")
    replace_hand(files, Element("mesh", filename="collision/balls.stl"))
    world = load(files)
    assert touches_cube(world, checker, np.array([0.0, 0, 0.045]))
    assert not touches_cube(world, checker, np.array([0.0, 0, 0.055]))
    replace_hand(files, Element("mesh", filename="collision/balls.stl", scale="0.5 2 1"))
    world = load(files)
    assert touches_cube(world, checker, np.array([0.0, 0.095, 0]))
    assert not touches_cube(world, checker, np.array([0.14, 0, 0]))


def test_hull_file_is_preferred_to_the_mesh(files, checker):
    trimesh.creation.box((0.02, 0.02, 1.4)).export(files / f"{HAND}.convex.stl")
    assert touches_cube(load(files), checker, np.array([0, 0, 0.09]))
    (files / f"{HAND}.convex.stl").unlink()
    assert not touches_cube(load(files), checker, np.array([0, 0, 0.09]))


def load_error(files: Path) -> RobotDescriptionError:
    with pytest.raises(RobotDescriptionError) as caught:
        load(files)
    assert caught.value.fix
    return caught.value


def test_missing_unreadable_or_flat_mesh_is_an_error(files):
    hull = files / f"{HAND}.convex.stl"
    for content in (b"", b"no mesh", b"solid x\nendsolid x\n"):
        hull.write_bytes(content)
        assert load_error(files).where == hull
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]])
    flat.export(hull)
    assert load_error(files).where == hull
    for path in (files / HAND, hull):
        path.unlink()
    error = load_error(files)
    assert error.where == files / HAND
    assert "panda_hand" in error.what


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("panda_arm.urdf", "<robot", "<<robot"),  # not XML
        ("panda_arm.urdf", "<limit", "<limits"),
        ("panda_arm.urdf", '<link name="panda_hand"', '<link name="hand"'),
        ("panda_arm.urdf", '<box size="', '<box size="0.1 0.1" length="'),
        ("panda_arm.urdf", "<mesh filename=", "<mesh file="),
        ("panda_arm.urdf", "<mesh ", "<capsule "),
        ("panda_arm.urdf", 'type="prismatic"', 'type="revolute"'),
        ("panda_arm.srdf", "</robot>", ""),
        ("panda_arm.urdf", None, None),  # missing
        ("panda_arm.srdf", None, None),
    ],
)
def test_damaged_description_is_an_error(files, name, old, new):
    path = files / name
    if old is None:
        path.unlink()
    else:
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))
    assert load_error(files).where == path


def test_bounding_boxes_contain_fingers_and_hand(panda_files, checker):
    """All collision shapes of the open left finger and the hand are inside the boxes, to 1.5 mm."""

    def vertices(link):
        return np.concatenate([of for name, of in checker.parts if name == link])

    tcp_in_hand = MOBILE_PANDA.stock_tcp_in_hand + MOBILE_PANDA.finger_extension
    finger = vertices("panda_leftfinger") + [0, MOBILE_PANDA.open_finger, 0.0584 - tcp_in_hand]
    hand = vertices("panda_hand") - [0, 0, tcp_in_hand]
    points = np.concatenate([finger, hand]) * [1, 1, 1]
    points[:, 1] = np.abs(points[:, 1])
    gaps = [
        np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=1) for low, high in GRIPPER_BOXES
    ]
    assert np.min(gaps, axis=0).max() < 1.5e-3
    joints = {j.attrib["name"]: j for j in ElementTree.parse(panda_files.arm_urdf).getroot().iterfind("joint")}
    assert joints["panda_finger_joint1"].find("origin").attrib["xyz"] == "0 0 0.0584"
