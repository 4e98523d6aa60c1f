# trimesh types a visual as None or either of two kinds; the tests know which one they have
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

import numpy as np
import pytest
import trimesh

from asset_tools.scan import guess_common_unit, guess_units, guess_up_axis, rotate_upright
from robocas_ms3.core.errors import AssetError


@pytest.mark.parametrize(
    ("longest", "unit"),
    [([0.2], "m"), ([8.4, 14.8, 10.3, 19.2], "cm"), ([196.0], "mm"), ([0.05, 0.3], "m"), ([30.0], "cm")],
)
def test_units_are_guessed_from_sizes(longest, unit):
    assert guess_common_unit(longest) == unit


def test_sizes_that_fit_no_unit_are_an_error():
    with pytest.raises(AssetError, match=r"found a longest side of 1e\+06\)\. Pass --units"):
        guess_common_unit([1e6])


@pytest.mark.parametrize(
    ("longest", "units"),
    [
        ({"a": 0.15, "b": 0.2, "c": 0.08, "odd": 190.0}, {"a": "m", "b": "m", "c": "m", "odd": "mm"}),
        ({"a": 8.0, "b": 15.0, "odd": 0.12}, {"a": "cm", "b": "cm", "odd": "m"}),
        ({"a": 8.0, "b": 15.0, "odd": 210.0}, {"a": "cm", "b": "cm", "odd": "mm"}),
        ({"a": 0.03, "b": 0.4}, {"a": "m", "b": "m"}),
    ],
)
def test_a_scan_in_another_unit_than_its_neighbours(longest, units):
    assert guess_units(longest) == units


def shape(kind, along):
    """A bottle-like cylinder or a box whose long side points along an axis."""
    mesh = trimesh.creation.cylinder(2, 12, sections=32) if kind == "cylinder" else trimesh.creation.box(kind)
    order = {"z": [0, 1, 2], "y": [0, 2, 1]}[along]
    mesh.vertices = mesh.vertices[:, order]
    return mesh


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("kind", ["cylinder", (7, 7, 19), (10, 5, 2.4)], ids=str)
def test_up_axis_of_a_bottle_a_carton_and_a_flat_box(kind, up):
    assert guess_up_axis(shape(kind, up)) == up


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_any_axis_can_be_turned_up(up):
    tip = np.zeros(3)
    tip["xyz".index(up[-1])] = -1.0 if up[0] == "-" else 1.0
    mesh = trimesh.creation.box([1, 2, 3])
    marked = trimesh.Trimesh(np.vstack([mesh.vertices, tip]), mesh.faces, process=False)
    turned = rotate_upright(marked, up)
    np.testing.assert_array_equal(turned.vertices[-1], [0, 0, 1])
    assert turned.volume == pytest.approx(6)  # turned, not mirrored
    np.testing.assert_array_equal(marked.vertices[-1], tip)  # the scan itself stays


def test_a_bottle_in_millimetres_among_boxes_in_centimetres():
    """149 mm would be 1.49 m: plausible alone, but not next to boxes of 10 cm."""
    sides = {"butter": 10.3, "cheese": 10.4, "dressing": 14.7, "ketchup": 148.6}
    assert guess_units(sides) == {"butter": "cm", "cheese": "cm", "dressing": "cm", "ketchup": "mm"}
    assert guess_units({**sides, "ketchup": 60.0})["ketchup"] == "cm"  # a long thing of 60 cm
