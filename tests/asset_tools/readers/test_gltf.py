"""glTF is decoded by the format's rules: what a viewer shows, or a warning per feature that is left out."""

import base64
import json

import numpy as np
import pytest
from models import BLUE, GREEN, RED, Gltf, box, shown_colors
from PIL import Image

from asset_tools.readers.model import read_model
from robocas_ms3.core.errors import AssetError

# four columns of colour
COLUMNS = Image.fromarray(np.array([[RED, GREEN, BLUE, (250, 250, 10)]] * 4, np.uint8))


def warnings(model):
    return [note for note in model.notes if note.startswith("warning:")]


def with_uvs(u, v=0.5, *, dtype="<f4", name="TEXCOORD_0", **more):
    """A textured box, all of whose vertices have one texture coordinate."""
    gltf = Gltf()
    values = np.tile([u, v], (gltf.count, 1))
    if dtype != "<f4":
        values = np.rint(values * np.iinfo(dtype[1:]).max)
    gltf.attribute(name, values.astype(dtype), **more)
    texture = {"index": gltf.texture(COLUMNS)}
    gltf.material(pbrMetallicRoughness={"baseColorTexture": texture})
    return gltf, texture


def check(gltf, tmp_path, color, *, warns=0):
    model = read_model(gltf.write(tmp_path / "mug.glb"))
    np.testing.assert_allclose(shown_colors(model.mesh), np.tile(color, (12, 1)), atol=1)
    assert len(warnings(model)) == warns, model.notes
    return model


@pytest.mark.parametrize(("dtype", "more"), [
    ("<f4", {}), ("<u1", {"normalized": True, "stride": 4}), ("<u2", {"normalized": True}), ("<u2", {})
])  # fmt: skip
def test_texture_coordinates_of_all_types(tmp_path, dtype, more):
    check(with_uvs(0.625, dtype=dtype, **more)[0], tmp_path, BLUE)


@pytest.mark.parametrize(("dtype", "scale"), [("<i2", 32767), ("<u2", 65535), ("<i1", 127)])
def test_quantised_positions(tmp_path, dtype, scale):
    mesh = box((0.1, 0.1, 0.1), (0.05, 0.05, 0.05))
    gltf = Gltf(mesh)
    positions = np.rint(mesh.vertices / 0.1 * scale).astype(dtype)
    width = positions.itemsize * 3
    gltf.attribute("POSITION", positions, normalized=True, stride=width + -width % 4)
    gltf.tree["nodes"][0]["scale"] = [0.1, 0.1, 0.1]
    gltf.tree["extensionsUsed"] = gltf.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    model = read_model(gltf.write(tmp_path / "mug.glb"))
    np.testing.assert_allclose(model.mesh.bounds, [[0, 0, 0], [0.1, 0.1, 0.1]], atol=1e-3)
    # without normalisation the node's scale does it all
    gltf.tree["accessors"][gltf.primitive["attributes"]["POSITION"]]["normalized"] = False
    gltf.tree["nodes"][0]["scale"] = [0.1 / scale] * 3
    np.testing.assert_allclose(read_model(gltf.write(tmp_path / "mug.glb")).mesh.extents, [0.1] * 3, atol=1e-3)


@pytest.mark.parametrize(("dtype", "top"), [("<f4", 1.0), ("<u1", 255), ("<u2", 65535)])
@pytest.mark.parametrize("width", [3, 4])
def test_vertex_colours_times_the_material(tmp_path, dtype, top, width):
    gltf = Gltf()
    colors = np.tile([top, top * 0.2, 0, top][:width], (gltf.count, 1)).astype(dtype)
    gltf.attribute("COLOR_0", colors, stride=colors.itemsize * 4)
    gltf.material(pbrMetallicRoughness={"baseColorFactor": [0.5, 1, 1, 1]})
    check(gltf, tmp_path, (188, 124, 0))  # sRGB of 0.5 and 0.2


def test_a_texture_next_to_a_plain_colour(tmp_path):
    gltf, _ = with_uvs(0.875)
    plain = {**gltf.primitive, "material": 1}
    gltf.tree["materials"].append({"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 1, 1]}})
    gltf.tree["meshes"][0]["primitives"].append(plain)
    colors = shown_colors(read_model(gltf.write(tmp_path / "mug.glb")).mesh)
    assert (colors[:12] == [250, 250, 10]).all() and (colors[12:] == [0, 0, 255]).all()


@pytest.mark.parametrize(
    ("transform", "color"),
    [
        ({"offset": [0.25, 0]}, GREEN),
        ({"scale": [7, 1]}, (250, 250, 10)),
        ({"rotation": np.pi / 2}, BLUE),  # u of the image is v of the mesh: three.js, Khronos's viewer
        ({"texCoord": 1}, BLUE),
    ],
)
def test_texture_transform(tmp_path, transform, color):
    gltf, texture = with_uvs(0.125, 0.625)
    gltf.attribute("TEXCOORD_1", np.tile([0.625, 0.5], (gltf.count, 1)).astype("<f4"))
    texture["extensions"] = {"KHR_texture_transform": transform}
    gltf.tree["extensionsUsed"] = gltf.tree["extensionsRequired"] = ["KHR_texture_transform"]
    check(gltf, tmp_path, color)


def test_second_set_of_texture_coordinates(tmp_path):
    gltf, texture = with_uvs(0.625, name="TEXCOORD_1")
    gltf.attribute("TEXCOORD_0", np.zeros((gltf.count, 2), "<f4"))
    texture["texCoord"] = 1
    check(gltf, tmp_path, BLUE)
    texture["texCoord"] = 2
    check(gltf, tmp_path, (255, 255, 255), warns=1)


def test_ignored_features_give_one_warning_each(tmp_path):
    gltf, texture = with_uvs(0.625)
    gltf.tree["materials"][0] |= {
        "normalTexture": texture,
        "alphaMode": "BLEND",
        "extensions": {"KHR_materials_clearcoat": {}},
    }
    gltf.primitive["targets"] = [{"POSITION": 0}]
    gltf.tree["nodes"][0]["skin"] = 0
    check(gltf, tmp_path, BLUE, warns=5)


def test_strips_fans_sparse_values_and_mirrored_nodes(tmp_path):
    gltf = Gltf()
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], "<f4")
    gltf.primitive["attributes"]["POSITION"] = gltf.array(points)
    gltf.primitive.pop("indices")
    gltf.primitive["mode"] = 5
    gltf.tree["nodes"] = [{"children": [1], "scale": [2, 2, 2]}, {"mesh": 0, "scale": [-1, 1, 1]}]
    mesh = read_model(gltf.write(tmp_path / "a.glb")).mesh
    assert mesh.area == pytest.approx(4) and (mesh.face_normals[:, 2] > 0.9).all()
    gltf.primitive["mode"] = 6
    assert read_model(gltf.write(tmp_path / "a.glb")).mesh.area == pytest.approx(4)
    where, new = gltf.view(np.array([3], "<u2").tobytes()), gltf.view(np.array([[0, 5, 0]], "<f4").tobytes())
    gltf.tree["accessors"][gltf.primitive["attributes"]["POSITION"]]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": where, "componentType": 5123},
        "values": {"bufferView": new},
    }
    assert read_model(gltf.write(tmp_path / "a.glb")).mesh.extents[1] == pytest.approx(10)


@pytest.mark.parametrize(
    ("u", "wrap", "color"),
    [
        (1.125, 10497, RED),
        (1.125, 33071, (250, 250, 10)),
        (-0.125, 33071, RED),
        (1.125, 33648, (250, 250, 10)),
        (1.375, 33648, BLUE),
        (1.0, 33071, (250, 250, 10)),
        (0.0, 33071, RED),
    ],
)
def test_samplers(tmp_path, u, wrap, color):
    gltf, _ = with_uvs(u)
    gltf.tree["samplers"] = [{"wrapS": wrap}]
    gltf.tree["textures"][0]["sampler"] = 0
    check(gltf, tmp_path, color)


def test_data_in_uris(tmp_path):
    gltf, _ = with_uvs(0.125)
    path = gltf.write(tmp_path / "a.glb")
    data = base64.b64encode(gltf.blob).decode().replace("+", "%2B").replace("/", "%2F")
    gltf.tree["buffers"] = [{"byteLength": len(gltf.blob), "uri": f"data:application/octet-stream;base64,{data}"}]
    path = tmp_path / "b.gltf"
    path.write_text(json.dumps(gltf.tree))
    assert (shown_colors(read_model(path).mesh) == RED).all()


@pytest.mark.parametrize("base", [{"baseColorFactor": [0, 0, 0, 1]}, {}])
def test_emissive_texture(tmp_path, base):
    """On black it is all there is to see; on other colours it is added."""
    gltf, texture = with_uvs(0.625)
    gltf.tree["materials"][0] = {
        "pbrMetallicRoughness": base or {"baseColorFactor": [1, 0, 0, 1]},
        "emissiveTexture": texture,
        "emissiveFactor": [1, 1, 1],
    }
    check(gltf, tmp_path, BLUE if base else (255, *BLUE[1:]))


def test_older_materials_and_light(tmp_path):
    gltf, texture = with_uvs(0.625)
    gltf.tree["materials"][0] = {
        "extensions": {
            "KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": texture, "diffuseFactor": [1, 1, 0, 1]},
            "KHR_materials_emissive_strength": {"emissiveStrength": 2},
        },
        "emissiveFactor": [0.5, 0, 0],
    }
    check(gltf, tmp_path, (255, BLUE[1], 0))


def test_compression_that_is_not_required_is_an_error_all_the_same(tmp_path):
    gltf, _ = with_uvs(0.125)
    gltf.tree["textures"][0] = {"extensions": {"KHR_texture_basisu": {"source": 0}}}
    with pytest.raises(AssetError):
        read_model(gltf.write(tmp_path / "a.glb"))
    gltf = Gltf()
    gltf.primitive["extensions"] = {"KHR_draco_mesh_compression": {}}
    assert len(read_model(gltf.write(tmp_path / "b.glb")).mesh.faces) == 12  # with a fallback
    del gltf.tree["accessors"][gltf.primitive["attributes"]["POSITION"]]["bufferView"]
    with pytest.raises(AssetError):
        read_model(gltf.write(tmp_path / "b.glb"))
