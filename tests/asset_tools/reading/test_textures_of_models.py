"""A file that a model names is read in every format, if it is there and below the imported folder."""

import json
from urllib.parse import quote

import numpy as np
import pytest
from models import RED, Gltf, box, image_file, shown_colors, write_obj

from asset_tools.reading.model import read_model
from robocas_ms3.core.errors import AssetError

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
TEXTURE = '<texture texture="p" texcoord="u"/>'


def write_mtl(folder, image):
    return write_obj(folder, color=None, mtl=f"newmtl skin\nmap_Kd {image}\n")


def write_library(folder, name):
    """The OBJ, whose materials are in that file."""
    return write_obj(folder, color=None, mtl=None, head=f"mtllib {name}")


def write_dae(folder, image, diffuse=TEXTURE):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "mug.dae").write_text(COLLADA.format(diffuse=diffuse, image=image))
    return folder / "mug.dae"


def write_ply(folder, image, comment="TextureFile {}"):
    mesh = box()
    head = f"ply\nformat ascii 1.0\ncomment {comment.format(image)}\nelement vertex {len(mesh.vertices)}\n"
    head += "".join(f"property float {name}\n" for name in "xyzst") + f"element face {len(mesh.faces)}\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(map(str, [*vertex, 0.5, 0.5])) for vertex in mesh.vertices]
    rows += [" ".join(map(str, [3, *face])) for face in mesh.faces]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "mug.ply").write_text(head + "\n".join(rows) + "\n")
    return folder / "mug.ply"


def write_glb(folder, image):
    gltf = Gltf()
    gltf.attribute("TEXCOORD_0", np.zeros((gltf.count, 2), "<f4"))
    gltf.material(pbrMetallicRoughness={"baseColorTexture": {"index": 0}})
    gltf.tree["images"], gltf.tree["textures"] = [{"uri": quote(image)}], [{"source": 0}]
    return gltf.write(folder / "mug.glb")


def write_gltf(folder, name):
    """The glTF, whose arrays are in that file."""
    gltf = Gltf()
    gltf.write(folder / "mug.glb")
    gltf.tree["buffers"][0]["uri"] = name
    (folder / "mug.gltf").write_text(json.dumps(gltf.tree))
    return folder / "mug.gltf"


TEXTURED = {"obj": write_mtl, "dae": write_dae, "ply": write_ply, "glb": write_glb}


@pytest.mark.parametrize("write", TEXTURED.values(), ids=TEXTURED)
def test_a_texture_is_shown(tmp_path, write):
    image_file(tmp_path / "my skin.png")
    model = read_model(write(tmp_path, "my skin.png"))
    assert (shown_colors(model.mesh) == RED).all() and tmp_path / "my skin.png" in model.files


@pytest.mark.parametrize("write", [*TEXTURED.values(), write_library, write_gltf], ids=lambda write: write.__name__)
def test_a_missing_file_is_an_error_that_names_it(tmp_path, write):
    with pytest.raises(AssetError) as caught:
        read_model(write(tmp_path, "lost one"))
    assert str(caught.value.where).endswith("lost one")


@pytest.mark.parametrize("link", [False, True])
@pytest.mark.parametrize("write", [*TEXTURED.values(), write_library, write_gltf], ids=lambda write: write.__name__)
def test_nothing_outside_of_the_imported_folder_is_read(tmp_path, write, link):
    root, name = tmp_path / "scans", "../../secret.png"
    secret = image_file(tmp_path / "secret.png")
    if link:
        name = "inside.png"
        (root / "mug").mkdir(parents=True)
        (root / "mug" / name).symlink_to(secret)
    with pytest.raises(AssetError) as caught:
        read_model(write(root / "mug", name), root)
    assert name.rsplit("/", 1)[-1] in str(caught.value.where)


@pytest.mark.parametrize(
    ("diffuse", "image", "color"),
    [(TEXTURE, "file:///home/me/SKIN.png", RED), ("<color>0.2 0.6 1 1</color>", "skin.png", (51, 153, 255))],
)
def test_collada(tmp_path, diffuse, image, color):
    image_file(tmp_path / "skin.png")
    model = read_model(write_dae(tmp_path, image, diffuse))
    assert shown_colors(model.mesh).tolist() == [list(color)] and model.up == "z"


@pytest.mark.parametrize("comment", ["  TextureFile    {}  ", "texturefile {}", "TEXTUREFILE SKIN.PNG"])
def test_comments_of_ply(tmp_path, comment):
    image_file(tmp_path / "skin.png")
    assert (shown_colors(read_model(write_ply(tmp_path, "skin.png", comment)).mesh) == RED).all()
