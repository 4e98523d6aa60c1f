"""Reading a model: what is wrong with a file is one typed error, and what the format says is kept."""

import json

import numpy as np
import pytest
import trimesh
from models import GREEN, RED, Gltf, box, image_file, shown_colors, write_obj
from PIL import Image

from asset_tools.reading.model import read_model
from robocas_ms3.core.errors import AssetError, RobocasError

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.obj", b""),
        ("a.obj", TRIANGLE[:24].encode()),
        ("a.obj", TRIANGLE.replace("v 1 0 0", "v nan 0 0").encode()),
        ("a.obj", TRIANGLE.replace("v 1 0 0", "v 1e300 0 0").encode()),
        ("a.obj", TRIANGLE.replace("v 1 0 0", "v 0 0 0").replace("v 0 1 0", "v 0 0 0").encode()),
        ("a.stl", b"solid"),
        ("a.stl", b"\0" * 80 + (10**9).to_bytes(4, "little")),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n"),
        ("a.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nend_header\n\0"),
        ("a.off", b"OFF\n3 1 0\n0 0 0\n"),
        ("a.3mf", b"PK"),
        ("a.glb", b"glTF"),
        ("a.gltf", b"[]"),
        ("a.gltf", b"[" * 100_000),
        ("a.fbx", b"Kaydara"),
    ],
    ids=str,
)
def test_a_damaged_file_is_one_typed_error(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(AssetError) as caught:
        read_model(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_gltf_whose_image_is_missing(tmp_path):
    gltf = Gltf()
    gltf.attribute("TEXCOORD_0", np.zeros((gltf.count, 2), "<f4"))
    gltf.tree["images"], gltf.tree["textures"] = [{"uri": "lost%20one.png"}], [{"source": 0}]
    gltf.material(pbrMetallicRoughness={"baseColorTexture": {"index": 0}})
    with pytest.raises(AssetError) as caught:
        read_model(gltf.write(tmp_path / "mug.glb"))
    assert str(caught.value.where).endswith("lost one.png")
    image_file(tmp_path / "maps" / "lost one.png", GREEN)
    assert shown_colors(read_model(tmp_path / "mug.glb").mesh)[0].tolist() == list(GREEN)


@pytest.mark.parametrize(
    "comment", ["TextureFile skin.png", "  TextureFile    skin.png  ", "texturefile skin.png", "TEXTUREFILE SKIN.PNG"]
)
def test_textures_of_ply(tmp_path, comment):
    image_file(tmp_path / "skin.png")
    mesh = box()
    head = f"ply\nformat ascii 1.0\ncomment {comment}\nelement vertex {len(mesh.vertices)}\n"
    head += "".join(f"property float {name}\n" for name in "xyzst") + f"element face {len(mesh.faces)}\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(map(str, [*vertex, 0.5, 0.5])) for vertex in mesh.vertices]
    rows += [" ".join(map(str, [3, *face])) for face in mesh.faces]
    (tmp_path / "mug.ply").write_text(head + "\n".join(rows) + "\n")
    assert (shown_colors(read_model(tmp_path / "mug.ply").mesh) == RED).all()
    (tmp_path / "skin.png").unlink()
    with pytest.raises(AssetError) as caught:
        read_model(tmp_path / "mug.ply")
    assert str(caught.value.where).lower().endswith("skin.png")


COLLADA = """<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_images><image id="i"><init_from>{image}</init_from></image></library_images>
<library_effects><effect id="e"><profile_COMMON>
<newparam sid="s"><surface type="2D"><init_from>i</init_from></surface></newparam>
<newparam sid="p"><sampler2D><source>s</source></sampler2D></newparam>
<technique sid="common"><lambert><diffuse>{diffuse}</diffuse></lambert></technique></profile_COMMON></effect>
</library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="x"><float_array id="xa" count="9">0 0 0 1 0 0 0 1 0</float_array><technique_common>
<accessor source="#xa" count="3" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<source id="t"><float_array id="ta" count="2">0.5 0.5</float_array><technique_common>
<accessor source="#ta" count="1" stride="2"><param name="S" type="float"/><param name="T" type="float"/></accessor>
</technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#x"/></vertices>
<triangles material="k" count="1"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="TEXCOORD" source="#t" offset="1" set="0"/><p>0 0 1 0 2 0</p></triangles></mesh></geometry>
</library_geometries>
<library_visual_scenes><visual_scene id="w"><node id="n"><instance_geometry url="#g"><bind_material><technique_common>
<instance_material symbol="k" target="#m"/></technique_common></bind_material></instance_geometry></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#w"/></scene></COLLADA>"""


@pytest.mark.parametrize(
    ("diffuse", "image", "color"),
    [
        ('<texture texture="p" texcoord="u"/>', "skin.png", RED),
        ('<texture texture="p" texcoord="u"/>', "file:///home/me/SKIN.png", RED),
        ("<color>0.2 0.6 1 1</color>", "skin.png", (51, 153, 255)),
    ],
)
def test_collada(tmp_path, diffuse, image, color):
    image_file(tmp_path / "skin.png")
    (tmp_path / "mug.dae").write_text(COLLADA.format(diffuse=diffuse, image=image))
    model = read_model(tmp_path / "mug.dae")
    assert shown_colors(model.mesh).tolist() == [list(color)] and model.up == "z"


@pytest.mark.parametrize("image", ["lost.png", "../../secret.png"])
def test_a_collada_texture_that_is_missing_or_outside(tmp_path, image):
    image_file(tmp_path / "secret.png")
    (tmp_path / "a" / "b").mkdir(parents=True)
    path = tmp_path / "a" / "b" / "mug.dae"
    path.write_text(COLLADA.format(diffuse='<texture texture="p" texcoord="u"/>', image=image))
    with pytest.raises(AssetError) as caught:
        read_model(path)
    assert image in str(caught.value.where)


def test_collada_without_pycollada_names_the_extra(tmp_path, monkeypatch):
    (tmp_path / "mug.dae").write_text("<COLLADA/>")
    monkeypatch.setattr("asset_tools.reading.exchange.find_spec", lambda name: None)
    with pytest.raises(RobocasError) as caught:
        read_model(tmp_path / "mug.dae")
    assert ".[assets]" in caught.value.fix


@pytest.mark.parametrize(
    ("mode", "dtype", "value"),
    [("I;16", np.uint16, 51400), ("L", np.uint8, 200), ("F", np.float32, 200 / 255)],
)
def test_grey_textures_of_all_depths(tmp_path, mode, dtype, value):
    path = write_obj(tmp_path, color=None, mtl=f"newmtl skin\nmap_Kd skin.{'tif' if mode == 'F' else 'png'}\n")
    Image.fromarray(np.full((4, 4), value, dtype)).save(tmp_path / f"skin.{'tif' if mode == 'F' else 'png'}")
    assert (shown_colors(read_model(path).mesh) == 200).all()


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
    path.write_text(path.read_text().replace("vt 0.5 0.5", "vt nan 1e300").replace("usemtl", "v nan 0 0\nusemtl"))
    model = read_model(path)
    assert (shown_colors(model.mesh) == 255).all() and any(note.startswith("warning:") for note in model.notes)
    gltf = Gltf()
    gltf.attribute("COLOR_0", np.full((gltf.count, 3), np.nan, "<f4"))
    model = read_model(gltf.write(tmp_path / "cup.glb"))
    assert (shown_colors(model.mesh) == 255).all() and any(note.startswith("warning:") for note in model.notes)


def test_a_missing_path(tmp_path):
    with pytest.raises(AssetError):
        read_model(tmp_path / "lost.obj")
    with pytest.raises(AssetError):
        read_model(tmp_path / "lost")


def test_the_axis_that_a_format_says_is_up(tmp_path):
    assert read_model(Gltf().write(tmp_path / "a.glb")).up == "y"
    assert read_model(write_obj(tmp_path)).up is None


def test_files_that_were_read_are_known(tmp_path):
    path = write_obj(tmp_path)
    image_file(tmp_path / "other.png")
    assert {file.name for file in read_model(path).files} == {"mug.obj", "skin.mtl", "skin.png"}


def test_colours_of_vertices_and_faces(tmp_path):
    mesh = box()
    mesh.visual.face_colors = np.tile([*GREEN, 255], (12, 1)).astype(np.uint8)
    mesh.export(tmp_path / "faces.ply")
    assert (shown_colors(read_model(tmp_path / "faces.ply").mesh) == GREEN).all()
    mesh.visual = trimesh.visual.ColorVisuals(vertex_colors=np.tile([*RED, 255], (8, 1)).astype(np.uint8))
    mesh.export(tmp_path / "vertices.ply")
    assert (shown_colors(read_model(tmp_path / "vertices.ply").mesh) == RED).all()


@pytest.mark.parametrize("mode", ["P", "LA", "RGBA", "1", "CMYK"])
def test_textures_of_all_modes(tmp_path, mode):
    path = write_obj(tmp_path, color=None, mtl="newmtl skin\nmap_Kd skin.tif\n")
    Image.new("RGB", (4, 4), (255, 255, 255)).convert(mode).save(tmp_path / "skin.tif")
    assert (shown_colors(read_model(path).mesh) == 255).all()


def test_json_of_gltf_may_hold_unknown_keys(tmp_path):
    gltf = Gltf()
    gltf.tree |= {"extras": {"deep": [{}]}, "unknown": 5, "asset": {"version": "2.0", "extras": 3}}
    model = read_model(gltf.write(tmp_path / "mug.glb"))
    assert json.dumps(model.notes) == "[]" and len(model.mesh.faces) == 12


def test_several_textures_of_the_name_that_is_searched_are_a_warning(tmp_path):
    for name in ("a", "b"):
        image_file(tmp_path / name / "skin.png")
    write_obj(tmp_path, color=None)
    assert any(note.startswith("warning:") for note in read_model(tmp_path).notes)
