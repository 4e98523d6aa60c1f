"""Write small models in the formats that can be imported."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import sapien
import trimesh
from PIL import Image
from sapien import physx

RED, GREEN, BLUE = (200, 30, 30), (30, 180, 40), (40, 60, 210)


def image_file(path: Path, color=RED, size=(4, 4), mode="RGB") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, size, color).save(path)
    return path


def box(size=(0.06, 0.05, 0.1), at=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(at)
    return mesh


def obj_text(mesh: trimesh.Trimesh, *, head="mtllib skin.mtl", use="usemtl skin", uvs=True) -> str:
    """Return an OBJ with texture coordinates: (V, 2), the center of the image (True), or none (False)."""
    lines = [head] if head else []
    lines += [f"v {x:.8f} {y:.8f} {z:.8f}" for x, y, z in mesh.vertices]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in ([[0.5, 0.5]] if isinstance(uvs, bool) else uvs)]
    lines += [use] if use else []
    corner = ("{0}/1" if uvs else "{0}") if isinstance(uvs, bool) else "{0}/{0}"
    lines += ["f " + " ".join(corner.format(i + 1) for i in face) for face in mesh.faces]
    return "\n".join(lines) + "\n"


def write_obj(folder: Path, name="mug", mesh=None, *, mtl="newmtl skin\nmap_Kd skin.png\n", color=RED, **text) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.obj").write_text(obj_text(box() if mesh is None else mesh, **text))
    if mtl is not None:
        (folder / "skin.mtl").write_text(mtl)
    if color is not None:
        image_file(folder / "skin.png", color)
    return folder / f"{name}.obj"


class Gltf:
    """Builder of a GLB file with one primitive of one mesh; tests change its JSON."""

    def __init__(self, mesh: trimesh.Trimesh | None = None) -> None:
        mesh = box() if mesh is None else mesh
        self.blob = b""
        self.tree: dict = {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "accessors": [],
            "bufferViews": [],
        }
        self.count = len(mesh.vertices)
        self.primitive = {
            "attributes": {"POSITION": self.array(np.asarray(mesh.vertices, "<f4"))},
            "indices": self.array(np.asarray(mesh.faces, "<u2").reshape(-1, 1)),
        }
        self.tree["meshes"] = [{"primitives": [self.primitive]}]

    def view(self, data: bytes, **more) -> int:
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data), **more})
        self.blob += data + b"\0" * (-len(data) % 4)
        return len(self.tree["bufferViews"]) - 1

    def array(self, values: np.ndarray, *, normalized=False, stride=0, **more) -> int:
        kinds = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
        data = values.tobytes()
        if stride:
            data = b"".join(row.tobytes().ljust(stride, b"\0") for row in values)
        accessor = {
            "bufferView": self.view(data, **({"byteStride": stride} if stride else {})),
            "componentType": kinds[values.dtype.str[1:]],
            "count": len(values),
            "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[values.shape[1]],
            **({"normalized": True} if normalized else {}),
            **more,
        }
        self.tree["accessors"].append(accessor)
        return len(self.tree["accessors"]) - 1

    def attribute(self, name: str, values: np.ndarray, **more) -> None:
        self.primitive["attributes"][name] = self.array(values, **more)

    def texture(self, image: Image.Image) -> int:
        """Add an image to the file as a texture; return the index of the texture."""
        stream = io.BytesIO()
        image.save(stream, "PNG")
        self.tree.setdefault("images", []).append({"bufferView": self.view(stream.getvalue()), "mimeType": "image/png"})
        self.tree.setdefault("textures", []).append({"source": len(self.tree["images"]) - 1})
        return len(self.tree["textures"]) - 1

    def material(self, **material) -> None:
        self.tree.setdefault("materials", []).append(material)
        self.primitive["material"] = len(self.tree["materials"]) - 1

    def write(self, path: Path) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.tree["buffers"] = [{"byteLength": len(self.blob)}]
        head = json.dumps(self.tree).encode()
        head += b" " * (-len(head) % 4)
        chunks = (
            struct.pack("<I4s", len(head), b"JSON") + head + struct.pack("<I4s", len(self.blob), b"BIN\0") + self.blob
        )
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


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
    """Write an OBJ whose materials are in the file `name`."""
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
    """Write a glTF whose arrays are in the file `name`."""
    gltf = Gltf()
    gltf.write(folder / "mug.glb")
    gltf.tree["buffers"][0]["uri"] = name
    (folder / "mug.gltf").write_text(json.dumps(gltf.tree))
    return folder / "mug.gltf"


def shown_colors(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the imported sRGB colour at the center of each face, (F, 3), 0 to 255."""
    from asset_tools.visual import Appearance

    faces = np.arange(len(mesh.faces))
    return np.rint(Appearance(mesh).sample_colors(np.asarray(mesh.faces), faces, np.full((len(faces), 3), 1 / 3)))


def texels(mesh: trimesh.Trimesh, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the colours (N, 3) of the texture at points (N, 3) on faces (N,)."""
    visual: Any = mesh.visual
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
    uv = np.einsum("nc,ncd->nd", weights, visual.uv[mesh.faces[faces]])
    pixels = np.asarray(visual.material.baseColorTexture.convert("RGB"), int)
    height, width = pixels.shape[:2]
    column, row = (uv[:, 0] * width).astype(int), ((1 - uv[:, 1]) * height).astype(int)
    return pixels[row.clip(0, height - 1), column.clip(0, width - 1)]


def ball_dropped_into(hulls: Path, start: list[float], radius: float) -> np.ndarray:
    """Drop a ball into a fixed container; return its resting position in the frame of the container, in m."""
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    builder = scene.create_actor_builder()
    builder.add_multiple_convex_collisions_from_file(str(hulls))
    builder.build_kinematic("container")
    builder = scene.create_actor_builder()
    builder.add_sphere_collision(radius=radius)
    builder.initial_pose = sapien.Pose(start)
    ball = builder.build("ball")
    for _ in range(200):
        scene.step()
    return ball.pose.p
