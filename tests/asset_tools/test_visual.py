"""Display copies keep colours, limits and orientation; GLB files are the same every time and load in SAPIEN."""

# trimesh types a visual as None or either of two kinds; the tests know which one they have
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import sapien
import trimesh
from models import texels
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from asset_tools.glb import write_glb
from asset_tools.readers.surface import Material, MeshPart, join_parts
from asset_tools.simplify import simplify_mesh
from asset_tools.visual import make_display_mesh

COLORS = np.array([[220, 30, 30], [30, 200, 40], [30, 40, 220], [230, 220, 40], [200, 40, 210], [40, 210, 210]])
SIDE = 0.1  # m


def textured_box(cells: int) -> trimesh.Trimesh:
    """A cube of ``12 cells²`` triangles, side k coloured ``COLORS[k]``: sides +x, -x, +y, -y, +z, -z.

    The texture has six columns; the vertices of a side are its own.
    """
    line = np.linspace(-0.5, 0.5, cells + 1)
    a, b = (grid.reshape(-1) for grid in np.meshgrid(line, line, indexing="ij"))
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1)
    right, up = corner + cells + 1, corner + 1
    square = np.concatenate([np.column_stack([corner, right, right + 1]), np.column_stack([corner, right + 1, up])])
    vertices, faces, uv = [], [], []
    for side in range(6):
        axis, sign = side // 2, 1 - 2 * (side % 2)
        points = np.zeros((len(a), 3))
        points[:, axis], points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = sign / 2, a, b
        vertices.append(points * SIDE)
        faces.append((square if sign > 0 else square[:, ::-1]) + side * len(a))
        uv.append(np.column_stack([(side + 0.5 + 0.8 * a) / 6, 0.5 + 0.9 * b]))
    image = Image.fromarray(np.repeat(np.repeat(COLORS[None].astype(np.uint8), 1024, axis=0), 170, axis=1))
    visual = TextureVisuals(uv=np.concatenate(uv), material=PBRMaterial(baseColorTexture=image, roughnessFactor=0.3))
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), visual=visual, process=False)


def seen_colors(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Points inside of each face and the texel shown there."""
    weights = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.2, 0.6], [1 / 3, 1 / 3, 1 / 3]])
    points = np.einsum("sc,fcd->fsd", weights, mesh.triangles).reshape(-1, 3)
    return points, texels(mesh, points, np.repeat(np.arange(len(mesh.faces)), len(weights)))


def side_of(points: np.ndarray) -> np.ndarray:
    axis = np.abs(points).argmax(axis=1)
    return 2 * axis + (points[np.arange(len(points)), axis] < 0)


@pytest.fixture(scope="module")
def fine_box() -> trimesh.Trimesh:
    return textured_box(41)


@pytest.fixture(scope="module")
def light_box(fine_box: trimesh.Trimesh) -> trimesh.Trimesh:
    return make_display_mesh(fine_box, triangles=600, texture_size=128)


def test_simplified_box_keeps_limits_frame_and_material(light_box):
    assert 12 <= len(light_box.faces) <= 600
    assert light_box.visual.material.baseColorTexture.size == (128, 128)
    assert light_box.visual.material.roughnessFactor == 0.3
    assert light_box.visual.material.metallicFactor == 0
    np.testing.assert_allclose(light_box.bounds, [[-SIDE / 2] * 3, [SIDE / 2] * 3], atol=1e-4)
    assert light_box.volume == pytest.approx(SIDE**3, rel=1e-2)
    assert light_box.visual.uv.min() >= 0 and light_box.visual.uv.max() <= 1


def test_simplified_box_keeps_the_colour_of_each_side(light_box):
    points, colors = seen_colors(light_box)
    inner = np.sort(np.abs(points), axis=1)[:, 1] < 0.45 * SIDE  # the edges of the sides may blend
    assert len(np.unique(side_of(points[inner]))) == 6
    assert np.abs(colors[inner] - COLORS[side_of(points[inner])]).max() <= 3


def test_sides_have_flat_normals_though_vertices_meet(light_box):
    normals = light_box.vertex_normals[light_box.faces]
    agreement = np.einsum("fcd,fd->fc", normals, light_box.face_normals)
    assert agreement.min() > 0.99  # one smooth normal at a box's corner would give 0.58


@pytest.mark.parametrize(
    "make",
    [
        lambda: textured_box(130),
        lambda: trimesh.creation.icosphere(subdivisions=7, radius=SIDE),
    ],
    ids=["box", "ball"],
)
def test_dense_meshes_do_not_fold_over(make):
    dense = make()
    assert len(dense.faces) > 200_000
    light = simplify_mesh(dense, 1000)
    assert len(light.faces) <= 1000
    assert light.volume == pytest.approx(dense.volume, rel=0.01)
    assert light.area == pytest.approx(dense.area, rel=0.01)
    np.testing.assert_allclose(light.bounds, dense.bounds, atol=0.01 * SIDE)


def test_a_gradient_lands_where_it_was():
    """Colours follow the position within 2 % of the size, not merely the side."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    ball.visual = trimesh.visual.ColorVisuals(ball, vertex_colors=(ball.vertices + 0.05) / 0.1)
    points, colors = seen_colors(make_display_mesh(ball, triangles=1000, texture_size=256))
    on_ball = points / np.linalg.norm(points, axis=1, keepdims=True) * 0.05
    assert np.abs(colors / 255 - (on_ball + 0.05) / 0.1).max() < 0.02


def test_thin_shell_keeps_inside_and_outside_apart():
    outer = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    inner = trimesh.creation.icosphere(subdivisions=5, radius=0.0495)
    inner.invert()
    outer.visual.vertex_colors = [200, 0, 0, 255]
    inner.visual.vertex_colors = [0, 0, 200, 255]
    light = make_display_mesh(trimesh.util.concatenate([outer, inner]), triangles=3000, texture_size=256)
    points, colors = seen_colors(light)
    facing_out = (points * np.repeat(light.face_normals, 4, axis=0)).sum(axis=1) > 0
    wanted = np.where(facing_out[:, None], [200, 0, 0], [0, 0, 200])
    wrong = np.abs(colors - wanted).max(axis=1) > 20
    assert 0.4 < facing_out.mean() < 0.6
    assert wrong.mean() < 0.005


def test_glb_is_the_same_every_time_and_readable(fine_box, light_box, tmp_path):
    write_glb(light_box, tmp_path / "a.glb")
    write_glb(make_display_mesh(fine_box, triangles=600, texture_size=128), tmp_path / "b.glb")
    data = (tmp_path / "a.glb").read_bytes()
    assert data == (tmp_path / "b.glb").read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    head = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    assert head["images"][0]["mimeType"] == "image/jpeg"
    loaded = trimesh.load(tmp_path / "a.glb", process=False, force="mesh")
    np.testing.assert_allclose(loaded.vertices, light_box.vertices, atol=1e-7)
    np.testing.assert_array_equal(loaded.faces, light_box.faces)
    np.testing.assert_allclose(loaded.visual.uv, light_box.visual.uv, atol=1e-6)
    texture = light_box.visual.material.baseColorTexture
    difference = np.asarray(loaded.visual.material.baseColorTexture, dtype=int) - np.asarray(texture)
    assert np.abs(difference).mean() < 5  # what JPEG loses at the borders of the colours


@pytest.mark.slow
def test_sapien_shows_each_side_of_the_glb(light_box, tmp_path):
    write_glb(light_box, tmp_path / "box.glb")
    scene = sapien.Scene()
    scene.set_ambient_light([1, 1, 1])
    builder = scene.create_actor_builder()
    builder.add_visual_from_file(str(tmp_path / "box.glb"))
    builder.set_initial_pose(sapien.Pose())
    builder.build_static()
    camera = scene.add_camera("camera", 32, 32, 0.3, 0.01, 10)
    looks = {0: [0, 0, 0, 1], 1: [1, 0, 0, 0], 2: [0.5**0.5, 0, 0, -(0.5**0.5)], 3: [0.5**0.5, 0, 0, 0.5**0.5]}
    for side, wxyz in looks.items():
        position = np.zeros(3)
        position[side // 2] = 0.3 * (1 - 2 * (side % 2))
        camera.entity.set_pose(sapien.Pose(position.tolist(), wxyz))
        scene.update_render()
        camera.take_picture()
        pixel = camera.get_picture("Color")[16, 16, :3]
        seen, wanted = pixel / np.linalg.norm(pixel), COLORS[side] / np.linalg.norm(COLORS[side])
        assert seen @ wanted > 0.97, f"side {side}: {pixel}"


@pytest.mark.parametrize("triangles", [2000, 400])
def test_a_label_close_to_a_bottle_keeps_its_colour(triangles):
    """Two layers half a millimetre apart, each with its image; also where faces are simplified."""
    parts = []
    for radius, height, color in ((0.03, 0.1, (200, 0, 0)), (0.0305, 0.05, (255, 255, 255))):
        wall = trimesh.creation.cylinder(radius, height, sections=96)
        uvs = np.full((len(wall.vertices), 2), 0.5)
        image = Image.new("RGB", (4, 4), color)
        parts.append(MeshPart(np.array(wall.vertices), np.array(wall.faces), uvs, material=Material(image=image)))
    light = make_display_mesh(join_parts(parts), triangles=triangles, texture_size=256)
    points, faces = trimesh.sample.sample_surface(light, 3000, seed=0)[:2]
    radius = np.linalg.norm(points[:, :2], axis=1)
    side = np.abs(light.face_normals[faces, 2]) < 0.3
    label = side & (radius > 0.0303) & (np.abs(points[:, 2]) < 0.022)
    bottle = side & (np.abs(points[:, 2]) > 0.028)
    seen = texels(light, points, faces)
    assert label.sum() > 200 and bottle.sum() > 200
    assert (seen[label, 1] > 200).mean() > 0.99 and (seen[bottle, 1] < 60).mean() > 0.99


def test_round_things_have_smooth_normals():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    light = make_display_mesh(ball, triangles=800)
    assert len(light.faces) <= 800
    outward = light.vertices / np.linalg.norm(light.vertices, axis=1, keepdims=True)
    assert (outward * light.vertex_normals).sum(axis=1).min() > 0.98
    assert len(light.vertices) < len(light.faces)  # shared


def test_light_mesh_keeps_geometry_and_uvs_and_shrinks_the_texture():
    box = textured_box(4)
    light = make_display_mesh(box, triangles=192, texture_size=256)
    np.testing.assert_array_equal(light.vertices, box.vertices)
    np.testing.assert_array_equal(light.faces, box.faces)
    np.testing.assert_array_equal(light.visual.uv, box.visual.uv)
    assert light.visual.material.baseColorTexture.size == (255, 256)  # of 1020 x 1024
    points, colors = seen_colors(light)
    assert np.abs(colors - COLORS[side_of(points)]).max() <= 3


@pytest.mark.parametrize("cells", [4, 20])
def test_inward_mesh_is_turned_outward(cells):
    box = textured_box(cells)
    box.invert()
    light = make_display_mesh(box, triangles=200, texture_size=64)
    assert light.volume == pytest.approx(SIDE**3, rel=1e-2)
    assert (np.einsum("fcd,fd->fc", light.vertex_normals[light.faces], light.face_normals) > 0.5).all()


def test_plain_mesh_has_a_colour_and_no_texture():
    ball = trimesh.creation.icosphere(subdivisions=4)
    ball.visual.face_colors = [124, 188, 255, 255]
    light = make_display_mesh(ball, triangles=500)
    assert light.visual.material.baseColorTexture is None
    assert light.visual.material.baseColorFactor.tolist() == [51, 128, 255, 255]  # linear, as glTF has it


def test_texture_that_repeats_is_looked_up_with_its_wrap():
    box = textured_box(20)
    shifted = box.copy()
    shifted.visual.uv = box.visual.uv + [3, -2]
    images = [
        np.asarray(make_display_mesh(m, triangles=300, texture_size=64).visual.material.baseColorTexture)
        for m in (box, shifted)
    ]
    assert np.abs(images[0].astype(int) - images[1]).max() <= 1
