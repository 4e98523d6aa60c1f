"""A cabinet of boxes: a drawer, a door, a board; then the same with faults."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from asset_tools.quality.furniture import examine_furniture, measure_furniture
from asset_tools.quality.surfaces import measure_clearances
from asset_tools.sources import FurnitureSource, LinkSource
from robocas_ms3.assets.manifest import Handle, Joint, Surface


def box(low, high):
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T.astype(float)


def drawer(name, y, friction=0.05):
    """A tray 0.3 m deep, 0.2 m wide, 0.1 m high, its front at x = 0.15, its bottom at z = 0.1."""
    pieces = [
        box((-0.15, y - 0.1, 0.1), (0.15, y + 0.1, 0.11)),
        box((0.14, y - 0.1, 0.11), (0.15, y + 0.1, 0.2)),
        box((-0.15, y - 0.1, 0.11), (-0.14, y + 0.1, 0.2)),
        box((-0.14, y - 0.1, 0.11), (0.14, y - 0.09, 0.2)),
        box((-0.14, y + 0.09, 0.11), (0.14, y + 0.1, 0.2)),
    ]
    joint = Joint(
        name=f"{name}_joint", kind="prismatic", axis=(1, 0, 0), limits=(0, 0.25), friction=friction, damping=5.0
    )
    return LinkSource(name, joint, trimesh.creation.box(), pieces, mass=1.0)


def door(limits=(0.0, 1.6)):
    """Hinged at the right of the front: x = 0.16, y = -0.2."""
    joint = Joint(
        name="hinge",
        kind="revolute",
        axis=(0, 0, -1),
        origin=(0.16, -0.2, 0),
        limits=limits,
        friction=0.05,
        damping=0.5,
    )
    pieces = [box((0.16, -0.2, 0.3), (0.18, 0.2, 0.6)), box((0.2, 0.14, 0.4), (0.22, 0.16, 0.5))]
    return LinkSource("door", joint, trimesh.creation.box(), pieces, mass=2.0)


def grip(position):
    """Of the door's bar, whose middle is (0.21, 0.15, 0.45): from the front, the fingers left and right of it."""
    return {"door": Handle(link="door", position=position, wxyz=(0.5**0.5, 0, -(0.5**0.5), 0), width=0.02)}


def cabinet(**changes):
    pieces = [
        box((-0.2, -0.25, 0.0), (0.15, 0.25, 0.05)),
        box((-0.2, -0.25, 0.25), (0.15, 0.25, 0.28)),
        box((-0.2, -0.25, 0.65), (0.15, 0.25, 0.68)),
    ]
    source = FurnitureSource(
        "cabinet",
        "cabinet",
        "cabinet",
        trimesh.creation.box(),
        pieces,
        surfaces={
            "top": Surface(min_xy=(-0.18, -0.2), max_xy=(0.13, 0.2), z=0.68),
            "layer": Surface(min_xy=(-0.18, -0.2), max_xy=(0.13, 0.2), z=0.28, headroom=0.37),
            "drawer": Surface(link="drawer", min_xy=(-0.13, -0.08), max_xy=(0.13, 0.08), z=0.11, headroom=0.14),
        },
        links=(drawer("drawer", 0.0), door()),
        handles=grip((0.21, 0.15, 0.45)),
    )
    return replace(source, **changes)


def test_a_good_cabinet_has_working_joints_and_surfaces():
    quality = measure_furniture(cabinet())
    assert (quality.joints_open, quality.surfaces_hold) == (1.0, 1.0)
    assert (quality.hull_count, quality.hull_vertices) == (10, 8)
    report = examine_furniture(cabinet())
    assert set(report.joints) == {"drawer_joint", "hinge"}
    assert all((joint.overlap, joint.grip) == (0, 0) for joint in report.joints.values())
    assert report.surfaces["layer"].headroom == pytest.approx(0.37, abs=1e-6)
    assert report.surfaces["drawer"].headroom == pytest.approx(0.14, abs=1e-6)
    assert report.surfaces["top"].headroom == np.inf
    assert measure_furniture(cabinet()) == quality


def test_a_door_in_front_of_a_drawer_is_found_to_block_it():
    low = door()
    low = replace(low, pieces=[box((0.16, -0.2, 0.1), (0.18, 0.2, 0.6)), *low.pieces[1:]], mass=500.0)
    report = examine_furniture(cabinet(links=(drawer("drawer", 0.0), low)))
    assert not report.joints["drawer_joint"].works
    assert report.joints["drawer_joint"].opened < 0.5


def test_a_drawer_buried_in_solid_wood_is_found_to_be_jammed():
    # the drawer's 0.1 m of height lie within the block, whose contacts with its own link the engine leaves out
    buried = cabinet(pieces=[*cabinet().pieces, box((-0.2, -0.25, 0.0), (0.15, 0.25, 0.25))])
    found = examine_furniture(buried).joints["drawer_joint"]
    assert found.opened > 0.9 and not found.works
    assert found.overlap == pytest.approx(0.14)  # to lift a side, 0.11 m above the floor, out of the block
    assert measure_furniture(buried).joints_open == 0.5


@pytest.mark.parametrize(("reach", "works"), [(0.0015, True), (0.003, False)])
def test_a_part_may_reach_two_millimetres_into_another(reach, works):
    # a stop next to the drawer's path that it hits halfway
    stop = box((0.2, 0.1 - reach, 0.1), (0.22, 0.14, 0.2))
    found = examine_furniture(cabinet(pieces=[*cabinet().pieces, stop], links=(drawer("drawer", 0.0),), handles={}))
    assert found.joints["drawer_joint"].overlap == pytest.approx(reach)
    assert found.joints["drawer_joint"].works == works


@pytest.mark.parametrize(
    ("position", "distance"),
    [
        ((0.226, 0.15, 0.45), 0.006),  # before the bar
        ((3, 3, 3), np.linalg.norm((2.82, 2.8, 2.4))),  # in mid-air
        ((0.17, 0.15, 0.45), np.inf),  # within the door, which is wider than the hand
    ],
)
def test_a_handle_without_a_part_does_not_work(position, distance):
    found = examine_furniture(cabinet(handles=grip(position))).joints["hinge"]
    assert found.grip == pytest.approx(distance)
    assert not found.works


def test_a_lid_that_falls_by_itself_is_not_still():
    hinge = door().joint.model_copy(update={"axis": (0, 1, 0), "origin": (0.16, 0, 0.3)})
    falling = replace(door(), joint=hinge, pieces=[box((0.16, -0.2, 0.3), (0.5, 0.2, 0.32))])
    assert examine_furniture(cabinet(links=(falling,), surfaces={})).joints["hinge"].drifted > 0.5


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"z": 0.66}, "inside of the board"),
        ({"z": 0.75}, "7 cm above it"),
        ({"z": 0.689}, "9 mm above it"),
        ({"z": 0.683}, "3 mm above it"),
        ({"z": 0.677}, "3 mm below it"),
        ({"min_xy": (-0.24, -0.2)}, "4 cm beyond its edge"),
        ({"max_xy": (-0.15, 0.2)}, "too narrow for anything"),
        ({"z": 0.28, "headroom": 0.4}, "less room than it says"),
        ({"z": 0.28, "headroom": None}, "not under the open sky"),
    ],
)
def test_bad_surfaces_do_not_hold(change, why):
    top = cabinet().surfaces["top"].model_copy(update=change)
    assert not examine_furniture(cabinet(surfaces={"top": top})).surfaces["top"].holds, why


def test_clearances_of_a_board_under_another():
    boards = [box((0, 0, 0), (1, 1, 0.1)), box((0, 0, 0.5), (1, 1, 0.6))]
    below, above = measure_clearances(
        boards, np.array([(0.5, 0.5, 0.3), (0.5, 0.5, 0.05), (2, 0.5, 0.3), (0.5, 0.5, 1.0)])
    )
    assert below == pytest.approx([0.2, 0.0, np.inf, 0.4])
    assert above == pytest.approx([0.2, 0.0, np.inf, np.inf])
