# trimesh types a visual as None or either of two kinds; the tests know which one they have
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

import json

import numpy as np
import pytest
import trimesh
from PIL import Image

from asset_tools.scan import find_mesh, guess_unit, guess_units, guess_up, load_scan, longest_side, upright
from robocas_ms3.errors import AssetError

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"


def write_obj(
    folder, *, texture="map.png", mtl=True, image=True, faces="f 1/1 2/2 3/3\n", vertices=TRIANGLE, options=""
):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "thing.obj").write_text(f"mtllib thing.mtl\nusemtl skin\n{vertices}{faces}")
    if mtl:
        (folder / "thing.mtl").write_text(f"newmtl skin\nKd 1 1 1\nmap_Kd {options}{texture}\n")
    if image:
        Image.new("RGB", (4, 4), (200, 30, 30)).save(folder / texture)
    return folder / "thing.obj"


def test_a_textured_obj_is_preferred(tmp_path):
    for name in ("nontextured.ply", "textured.obj", "a.stl"):
        (tmp_path / name).touch()
    assert find_mesh(tmp_path).name == "textured.obj"
    with pytest.raises(AssetError, match="no such mesh"):
        find_mesh(tmp_path / "spam")
    (tmp_path / "sub").mkdir()
    with pytest.raises(AssetError, match="no mesh in this folder"):
        find_mesh(tmp_path / "sub")
    (tmp_path / "notes.txt").touch()
    with pytest.raises(AssetError, match=r"not a mesh file \(expected one of \.obj.*found \.txt"):
        find_mesh(tmp_path / "notes.txt")


def test_texture_and_uv_arrive(tmp_path):
    mesh = load_scan(write_obj(tmp_path, texture="my map.png", options="-s 1 1 1 -clamp on "))
    assert mesh.visual.uv.shape == (3, 2)
    assert mesh.visual.material.image.convert("RGB").getpixel((0, 0)) == (200, 30, 30)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mtl": False}, r"thing\.mtl: the material file that the mesh names is missing"),
        ({"image": False}, r"map\.png: the texture file that the material names is missing"),
        ({"faces": ""}, r"thing\.obj: the mesh is empty"),
        ({"vertices": TRIANGLE.replace("v 1 0 0", "v nan 0 0")}, r"not finite \(found 1 of 3\)"),
        ({"vertices": TRIANGLE.replace("v 1 0 0", "v 0 0 0").replace("v 0 1 0", "v 0 0 0")}, "has no size"),
        ({"vertices": "v 0 0 0\n"}, r"thing\.obj: "),
    ],
)
def test_bad_files_are_one_line_that_names_them(tmp_path, changes, message):
    path = write_obj(tmp_path, **changes)
    with pytest.raises(AssetError, match=message) as caught:
        load_scan(path)
    assert "\n" not in str(caught.value)


def test_a_texture_cut_short(tmp_path):
    path = write_obj(tmp_path)
    image = tmp_path / "map.png"
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(image)
    image.write_bytes(image.read_bytes()[:2000])
    with pytest.raises(AssetError, match=r"map\.png: can't read the texture"):
        load_scan(path)


def test_a_gltf_whose_image_is_missing(tmp_path):
    path = tmp_path / "thing.gltf"
    path.write_text(json.dumps({"images": [{"uri": "lost%20one.png"}]}))
    with pytest.raises(AssetError, match=r"lost one\.png: a file this mesh names is missing"):
        load_scan(path)


@pytest.mark.parametrize(
    ("longest", "unit"),
    [([0.2], "m"), ([8.4, 14.8, 10.3, 19.2], "cm"), ([196.0], "mm"), ([0.05, 0.3], "m"), ([30.0], "cm")],
)
def test_units_are_guessed_from_sizes(longest, unit):
    assert guess_unit(longest) == unit


def test_sizes_of_no_unit():
    with pytest.raises(AssetError, match=r"found 1e\+06 units\)\. Pass --units"):
        guess_unit([1e6])


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


def test_a_scan_of_no_unit_is_named():
    with pytest.raises(AssetError, match=r"^odd: can't guess the unit"):
        guess_units({"a": 0.1, "b": 0.2, "odd": 1e6})


@pytest.mark.parametrize("suffix", ["obj", "ply"])
def test_longest_side(tmp_path, suffix):
    trimesh.creation.box([1, 7, 3]).export(tmp_path / f"box.{suffix}")
    assert longest_side(tmp_path / f"box.{suffix}") == pytest.approx(7)


def shape(kind, along):
    """A bottle-like cylinder or a box whose long side points along an axis."""
    mesh = trimesh.creation.cylinder(2, 12, sections=32) if kind == "cylinder" else trimesh.creation.box(kind)
    order = {"z": [0, 1, 2], "y": [0, 2, 1]}[along]
    mesh.vertices = mesh.vertices[:, order]
    return mesh


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("kind", ["cylinder", (7, 7, 19), (10, 5, 2.4)], ids=str)
def test_up_axis_of_a_bottle_a_carton_and_a_flat_box(kind, up):
    assert guess_up(shape(kind, up)) == up


def test_gltf_has_y_up():
    assert guess_up(shape("cylinder", "z"), ".glb") == "y"


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_any_axis_can_be_turned_up(up):
    tip = np.zeros(3)
    tip["xyz".index(up[-1])] = -1.0 if up[0] == "-" else 1.0
    mesh = trimesh.creation.box([1, 2, 3])
    marked = trimesh.Trimesh(np.vstack([mesh.vertices, tip]), mesh.faces, process=False)
    turned = upright(marked, up)
    np.testing.assert_array_equal(turned.vertices[-1], [0, 0, 1])
    assert turned.volume == pytest.approx(6)  # turned, not mirrored
    np.testing.assert_array_equal(marked.vertices[-1], tip)  # the scan itself stays


def test_a_bottle_in_millimetres_among_boxes_in_centimetres():
    """149 mm would be 1.49 m, which a hand could still pick up, but no such thing lies among boxes of 10 cm."""
    sides = {"butter": 10.3, "cheese": 10.4, "dressing": 14.7, "ketchup": 148.6}
    assert guess_units(sides) == {"butter": "cm", "cheese": "cm", "dressing": "cm", "ketchup": "mm"}
    assert guess_units({**sides, "ketchup": 60.0})["ketchup"] == "cm"  # a long thing of 60 cm
