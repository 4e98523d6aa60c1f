"""Reading a model: what is wrong with a file is one typed error, and what the format says is kept."""

import json

import numpy as np
import pytest
import trimesh
from models import GREEN, RED, Gltf, box, image_file, shown_colors, write_obj
from PIL import Image

from asset_tools.readers.model import read_model
from robocas_ms3.core.errors import AssetError, RobocasError


def test_collada_without_pycollada_names_the_extra(tmp_path, monkeypatch):
    (tmp_path / "mug.dae").write_text("<COLLADA/>")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(RobocasError) as caught:
        read_model(tmp_path / "mug.dae")
    assert ".[assets]" in caught.value.fix


PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property float s
property float t
{colors}element face 1
property list uchar int vertex_indices
end_header
0 0 0 0 0{color}
1 0 0 1 0{color}
0 1 0 0 1{color}
3 0 1 2
"""


@pytest.mark.parametrize(
    ("names", "color", "shown"),
    [
        ("", "", (255, 255, 255)),
        ("red green blue", " 200 30 30", RED),
        ("diffuse_red diffuse_green diffuse_blue", " 200 30 30", RED),
    ],
)
def test_ply_with_coordinates_and_no_image(tmp_path, names, color, shown):
    colors = "".join(f"property uchar {name}\n" for name in names.split())
    (tmp_path / "mug.ply").write_text(PLY.format(colors=colors, color=color))
    model = read_model(tmp_path / "mug.ply")
    assert shown_colors(model.mesh).tolist() == [list(shown)] and model.notes == ()


def test_the_texture_of_another_object_is_not_taken(tmp_path):
    image_file(tmp_path / "banana" / "skin.png", GREEN)
    path = write_obj(tmp_path, color=None)
    with pytest.raises(AssetError):
        read_model(path, tmp_path)
    image_file(tmp_path / "mug_textures" / "skin.png", RED)
    assert shown_colors(read_model(path, tmp_path).mesh)[0].tolist() == list(RED)


def test_values_that_are_not_finite(tmp_path):
    """Coordinates and colours are left out with a warning; vertices that no face uses do not count."""
    path = write_obj(tmp_path)
    path.write_text(
        path.read_text().replace("vt 0.500000 0.500000", "vt nan 1e300").replace("usemtl", "v nan 0 0\nusemtl")
    )
    model = read_model(path)
    assert (shown_colors(model.mesh) == 255).all() and any(note.startswith("warning:") for note in model.notes)
    gltf = Gltf()
    gltf.attribute("COLOR_0", np.full((gltf.count, 3), np.nan, "<f4"))
    model = read_model(gltf.write(tmp_path / "cup.glb"))
    assert (shown_colors(model.mesh) == 255).all() and any(note.startswith("warning:") for note in model.notes)


def test_the_up_axis_of_a_format(tmp_path):
    assert read_model(Gltf().write(tmp_path / "a.glb")).up == "y"
    assert read_model(write_obj(tmp_path)).up is None


def test_colours_of_vertices_and_faces(tmp_path):
    mesh = box()
    mesh.visual.face_colors = np.tile([*GREEN, 255], (12, 1)).astype(np.uint8)
    mesh.export(tmp_path / "faces.ply")
    assert (shown_colors(read_model(tmp_path / "faces.ply").mesh) == GREEN).all()
    mesh.visual = trimesh.visual.ColorVisuals(vertex_colors=np.tile([*RED, 255], (8, 1)).astype(np.uint8))
    mesh.export(tmp_path / "vertices.ply")
    assert (shown_colors(read_model(tmp_path / "vertices.ply").mesh) == RED).all()


def test_json_of_gltf_may_hold_unknown_keys(tmp_path):
    gltf = Gltf()
    gltf.tree |= {"extras": {"deep": [{}]}, "unknown": 5, "asset": {"version": "2.0", "extras": 3}}
    model = read_model(gltf.write(tmp_path / "mug.glb"))
    assert json.dumps(model.notes) == "[]" and len(model.mesh.faces) == 12


WHITE, GREY = Image.new("RGB", (4, 4), (255, 255, 255)), np.full((4, 4), 1.0)


@pytest.mark.parametrize(
    ("image", "color"),
    [
        *((WHITE.convert(mode), 255) for mode in ("P", "LA", "RGBA", "1", "CMYK")),
        (Image.fromarray((51400 * GREY).astype(np.uint16)), 200),
        (Image.fromarray((200 * GREY).astype(np.uint8)), 200),
        (Image.fromarray((200 / 255 * GREY).astype(np.float32)), 200),
    ],
    ids=lambda value: getattr(value, "mode", ""),
)
def test_textures_of_all_modes_and_depths(tmp_path, image, color):
    path = write_obj(tmp_path, color=None, mtl="newmtl skin\nmap_Kd skin.tif\n")
    image.save(tmp_path / "skin.tif")
    assert (shown_colors(read_model(path).mesh) == color).all()


def test_several_textures_with_the_searched_name_give_a_warning(tmp_path):
    for name in ("a", "b"):
        image_file(tmp_path / name / "skin.png")
    write_obj(tmp_path, color=None)
    assert any(note.startswith("warning:") for note in read_model(tmp_path).notes)
