"""Damaged model files: each format and each kind of damage is one error of one line."""

import pytest
from irregular import KINDS, replace_file
from models import box, write_dae, write_gltf, write_mtl, write_obj, write_ply
from test_gltf import with_uvs

from asset_tools.readers.model import read_model
from robocas_ms3.core.errors import AssetError


def exported(folder, suffix):
    box().export(folder / f"mug.{suffix}")
    return folder / f"mug.{suffix}"


WRITERS = {
    "obj": lambda folder: write_mtl(folder, "skin.png"),
    "dae": lambda folder: write_dae(folder, "skin.png"),
    "ply": lambda folder: write_ply(folder, "skin.png"),
    "glb": lambda folder: with_uvs(0.125)[0].write(folder / "mug.glb"),
    "gltf": lambda folder: write_gltf(folder, "mug.bin"),
    "stl": lambda folder: exported(folder, "stl"),
    "off": lambda folder: exported(folder, "off"),
    "3mf": lambda folder: exported(folder, "3mf"),
}
DAMAGES = {
    "empty": lambda whole: b"",
    "cut in the head": lambda whole: whole[:19],
    "cut in half": lambda whole: whole[: len(whole) // 2],
    "zeros": lambda whole: bytes(len(whole)),
    "brackets": lambda whole: b"[" * 100_000,
}


def refused(path):
    with pytest.raises(AssetError) as caught:
        read_model(path)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_a_damaged_file(tmp_path, write, damage):
    path = write(tmp_path)
    path.write_bytes(damage(path.read_bytes()))
    refused(path)


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
PLY = "ply\nformat {}\nelement vertex {}\nproperty float x\nend_header\n"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("mug.obj", TRIANGLE.replace("v 1 0 0", "v nan 0 0")),
        ("mug.obj", TRIANGLE.replace("v 1 0 0", "v 1e300 0 0")),
        ("mug.obj", TRIANGLE.replace("1 0", "0 0")),
        ("mug.obj", TRIANGLE.replace("v 1 0 0", "v a b c")),
        ("mug.obj", TRIANGLE.replace("v 1 0 0", "v 0 0")),
        ("mug.obj", TRIANGLE.replace("f 1", "f 0")),
        ("mug.obj", TRIANGLE.replace("f 1", "f 4")),
        ("mug.obj", TRIANGLE.replace("f 1", "f -4")),
        ("mug.obj", TRIANGLE.replace("f 1", "f 1/9")),
        ("mug.obj", TRIANGLE + "".join(f"usemtl m{i}\nf 1 2 3\n" for i in range(2000))),
        ("mug.stl", "\0" * 80 + "\0\x6a\x7f\x3f"),
        ("mug.ply", PLY.format("ascii 1.0", 10**12)),
        ("mug.ply", PLY.format("binary_little_endian 1.0", 3) + "\0"),
        ("mug.fbx", "Kaydara"),
    ],
    ids=lambda value: value[-30:],
)
def test_content_that_cannot_be_read(tmp_path, name, content):
    (tmp_path / name).write_text(content, encoding="latin-1")
    assert refused(tmp_path / name).where == tmp_path / name


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        ("materials", 5),
        ("nodes", {"mesh": 0}),
        ("nodes 0 mesh", 7),
        ("nodes 0 mesh", "../x"),
        ("nodes 0 children", [0]),
        ("nodes 0 matrix", [1.0]),
        ("nodes 0 scale", [1e308, 1e308, 1e308]),
        ("scenes 0 nodes", [0, 0]),
        ("accessors 0 count", 10**9),
        ("accessors 0 count", -1),
        ("accessors 0 componentType", 9),
        ("accessors 0 byteOffset", 10**15),
        ("accessors 0 bufferView", 99),
        ("bufferViews 0 byteLength", 10**12),
        ("bufferViews 0 byteStride", 0),
        ("bufferViews 0 buffer", 3),
        ("meshes 0 primitives 0 attributes", []),
        ("meshes 0 primitives 0 attributes POSITION", 1),
        ("meshes 0 primitives 0 indices", 0),
        ("meshes 0 primitives", []),
        ("materials 0 pbrMetallicRoughness baseColorTexture index", 8),
        ("materials 0 pbrMetallicRoughness baseColorFactor", [1, "x"]),
        ("materials 0 pbrMetallicRoughness baseColorTexture extensions", {"KHR_texture_transform": 5}),
        ("textures 0 source", 4),
        ("images 0", {}),
        ("images 0", {"uri": "data:image/png;base64,AAAA"}),
        ("extensionsRequired", ["KHR_draco_mesh_compression"]),
    ],
    ids=str,
)
def test_json_of_gltf_that_cannot_be_used(tmp_path, keys, value):
    gltf, _ = with_uvs(0.125)
    *parents, last = [int(key) if key.isdigit() else key for key in keys.split()]
    place = gltf.tree
    for key in parents:
        place = place[key]
    place[last] = value
    refused(gltf.write(tmp_path / "mug.glb"))


@pytest.mark.parametrize("kind", [*KINDS, "folder", "loop"])
@pytest.mark.parametrize("name", ["mug.obj", "skin.mtl", "skin.png"])
def test_only_regular_files_of_bounded_size_are_read(tmp_path, kind, name):
    path = write_obj(tmp_path)
    replace_file(tmp_path / name, kind)
    refused(path)


def test_a_missing_path(tmp_path):
    refused(tmp_path / "lost.obj")
    refused(tmp_path / "lost")
