"""OBJ and MTL as exporters write them: the texture is found, or its loss is said."""

import numpy as np
import pytest
from models import GREEN, RED, box, image_file, shown_colors, write_obj

from asset_tools.readers.model import read_model
from asset_tools.readers.obj import parse_mtl, parse_obj
from robocas_ms3.core.errors import AssetError


def warnings(model):
    return [note for note in model.notes if note.startswith("warning:")]


@pytest.mark.parametrize(
    ("mtl", "text"),
    [
        ("newmtl skin\nmap_Kd skin.png\n", {"use": ""}),
        ("newmtl skin\nmap_Kd skin.png\n", {"use": "usemtl unknown"}),
        ("newmtl skin\nmap_Kd skin.png\nnewmtl plain\nKd 0 1 0\n", {"use": "usemtl unknown"}),
        ("newmtl Skin\nmap_Kd skin.png\n", {"use": "usemtl SKIN"}),
        ("newmtl\tmy  skin\nmap_Kd\t skin.png\n", {"use": "usemtl   my skin "}),
        ("NEWMTL skin\nKD 1 1 1\nMAP_KD skin.png\n", {}),
        ("newmtl skin\nKd 0 0 0\nmap_Kd -clamp on -s 1 1 1 skin.png\n", {}),
        ("newmtl skin\nmap_Kd -s\t1 1 1\tskin.png\n", {}),
        ("newmtl skin\nmap_Ka skin.png\n", {}),
        ("newmtl skin\nKd 0 0 0\nmap_Ke skin.png\n", {}),
        ("newmtl skin\nmap_Kd SKIN.PNG\n", {}),
        ("newmtl skin\nmap_Kd skin.png\nnewmtl unused\nmap_Kd lost.png\n", {}),
        ("newmtl skin\nmap_Kd skin.png\n", {"head": "  mtllib  skin.mtl"}),
        ("newmtl skin\nmap_Kd skin.png\n", {"head": "mtllib other.mtl skin.mtl"}),
        ("newmtl skin\nmap_Kd skin.png\n", {"head": "mtllib lost.mtl skin.mtl"}),
    ],
)  # fmt: skip
def test_the_texture_is_found(tmp_path, mtl, text):
    path = write_obj(tmp_path, mtl=mtl, **text)
    (tmp_path / "other.mtl").write_text("newmtl other\nKd 0 0 1\n")
    model = read_model(path)
    np.testing.assert_array_equal(shown_colors(model.mesh), np.tile(RED, (12, 1)))
    assert warnings(model) == []


SKIN = "newmtl skin\nmap_Kd skin.png\n"


@pytest.mark.parametrize(
    ("files", "text"),
    [
        ({"mug.mtl": SKIN}, {"head": "mtllib lost.mtl"}),
        ({"MUG.MTL": SKIN}, {"head": "", "use": ""}),
        ({"any.mtl": SKIN}, {"head": "mtllib lost.mtl"}),
        ({"mug.png": ""}, {"head": ""}),
    ],
)
def test_an_obvious_substitute_is_taken_and_reported(tmp_path, files, text):
    path = write_obj(tmp_path, mtl=None, **text)
    for name, content in files.items():
        (tmp_path / name).write_text(content) if content else image_file(tmp_path / name)
    model = read_model(path)
    np.testing.assert_array_equal(shown_colors(model.mesh), np.tile(RED, (12, 1)))
    assert any(name in note for note in model.notes for name in files)


def test_the_only_material_file_is_not_taken_if_it_lacks_a_material(tmp_path):
    with pytest.raises(AssetError):
        read_model(write_obj(tmp_path, head="mtllib untitled.mtl", mtl="newmtl other\n"))


@pytest.mark.parametrize(
    ("mtl", "text", "warns"),
    [
        ("newmtl a\nmap_Kd skin.png\nnewmtl b\nmap_Kd other.png\n", {"use": "usemtl c"}, True),
        (None, {"head": "", "use": ""}, False),
        (None, {"head": ""}, True),
        (None, {"head": "", "uvs": False, "use": ""}, False),
        ("newmtl skin\nmap_Kd skin.png\n", {"uvs": False}, True),
    ],
)
def test_faces_without_a_texture_are_white(tmp_path, mtl, text, warns):
    path = write_obj(tmp_path, mtl=mtl, **text)
    image_file(tmp_path / "other.png", GREEN)
    model = read_model(path)
    np.testing.assert_array_equal(shown_colors(model.mesh), np.full((12, 3), 255))
    assert bool(warnings(model)) == warns


def test_vertex_colours_of_an_obj(tmp_path):
    mesh = box()
    text = "".join(f"v {x} {y} {z} 0 0.5 1\n" for x, y, z in mesh.vertices)
    text += "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in mesh.faces)
    (tmp_path / "m.obj").write_text(text)
    np.testing.assert_array_equal(shown_colors(read_model(tmp_path / "m.obj").mesh), np.tile([0, 128, 255], (12, 1)))


def test_polygons_and_indices_counted_from_the_end():
    mesh = parse_obj("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\nf -4 -3 -2\nl 1 2\nf 1 2\n", "m")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]


def test_many_concave_polygons_take_linear_time():
    quad = "v 0 0 0\nv 2 0 0\nv 0.5 0.5 0\nv 0 2 0\n"
    mesh = parse_obj(quad + "f 1 2 3 4\nf 2 3 4 1\n" * 5000, "many.obj")
    sides = mesh.vertices[mesh.faces]
    areas = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])[:, 2] / 2
    assert (areas > 0).all() and areas.sum() == pytest.approx(10_000)


@pytest.mark.parametrize(
    ("old", "new"), [("\n", "\n   "), ("usemtl skin", "usemtl \\\n skin"), ("\nf ", " # seam\nf ")]
)
def test_lines_indented_continued_and_with_comments(tmp_path, old, new):
    path = write_obj(tmp_path, mtl="newmtl skin\nd 0.5\nmap_Kd skin.png\n")
    path.write_text(path.read_text().replace(old, new))
    model = read_model(path)
    assert (shown_colors(model.mesh) == RED).all() and warnings(model) == ["warning: ignored transparency"]


def test_options_of_a_map_statement():
    found = parse_mtl("newmtl a\nmap_Kd -S 2 3 1 -o 0.5 -bm 1 my skin.png\n")["a"]
    assert (found.image, found.uv_scale, found.uv_offset) == ("my skin.png", (2.0, 3.0), (0.5, 0.0))


def test_vertex_colours_next_to_a_texture_are_ignored_with_a_warning(tmp_path):
    path = write_obj(tmp_path)
    lines = [f"{line} 0.5 0.5 0.5" if line.startswith("v ") else line for line in path.read_text().splitlines()]
    path.write_text("\n".join(lines))
    model = read_model(path)
    assert (shown_colors(model.mesh) == RED).all() and len(warnings(model)) == 1


@pytest.mark.parametrize(("kd", "factor"), [("0.8 0.8 0.8", 1.0), ("1 0 0", 0.0)])
def test_a_coloured_kd_tints_a_texture_and_a_grey_one_does_not(tmp_path, kd, factor):
    path = write_obj(tmp_path, mtl=f"newmtl skin\nKd {kd}\nmap_Kd skin.png\n")
    expected = [RED[0], factor * RED[1], factor * RED[2]]
    np.testing.assert_allclose(shown_colors(read_model(path).mesh), np.tile(expected, (12, 1)), atol=1)
