import io
from functools import cache
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import KDTree
from shapely import MultiPoint, Point

from asset_tools.builtin import blends
from asset_tools.builtin.catalogue import products
from asset_tools.builtin.models import Model, Part, paint_in_space, unwrapped
from asset_tools.builtin.toys import STICKERS, scrambled
from asset_tools.decompose import GPU_LIMIT, flat_faces
from asset_tools.glb import write_glb
from asset_tools.grasps import sample_grasps
from asset_tools.quality.hulls import volume_iou
from robocas_ms3.assets.cooking import cooking_faults
from robocas_ms3.assets.hulls import write_hulls
from robocas_ms3.assets.pack import HULLS

TOYS = [p for p in products().values() if p.model or p.category in ("ball", "toy")]
IDS = [spec.id for spec in TOYS]
# Built in the fast run too: one of each kind, a thin one, and those with holes. The others take seconds each.
QUICK = {"padlock", "scissors", "small_elephant", "rubiks_cube", "racquetball"}
each = pytest.mark.parametrize(
    "spec", [pytest.param(s, marks=() if s.id in QUICK else pytest.mark.slow) for s in TOYS], ids=IDS
)
GRASPNET = {
    "power_drill": 8,
    "scissors": 9,
    "flat_screwdriver": 20,
    "racquetball": 21,
    "toy_airplane_a": 24,
    "toy_airplane_c": 25,
    "toy_airplane_k": 31,
    "padlock": 32,
    "white_mouse": 47,
    "large_elephant": 51,
    "rhinoceros": 52,
    "small_elephant": 53,
    "monkey": 54,
    "rubiks_cube": 71,
}


@cache
def built(name):
    return products()[name].build()


def picture(name):
    visual: Any = built(name)[1].visual
    return np.asarray(visual.material.baseColorTexture.convert("RGB"), float)


def share_near(pixels, colour, reach=60):
    return float((np.linalg.norm(pixels - np.array(colour), axis=-1) < reach).mean())


def test_table():
    assert {spec.id: spec.graspnet_id for spec in TOYS} == GRASPNET
    names = [spec.name for spec in TOYS]
    assert len(set(names)) == len(names)
    assert all("_" not in name for name in names)
    assert {spec.id for spec in TOYS if spec.hollow} == {
        "scissors",
        "toy_airplane_a",
        "toy_airplane_c",
        "toy_airplane_k",
    }
    for spec in TOYS:
        assert 0.03 <= spec.mass <= 0.9


@each
def test_closed_and_of_the_declared_size(spec):
    shape = built(spec.id)[0]
    closed = shape.closed()
    assert closed.is_watertight and closed.is_winding_consistent and closed.body_count == 1
    np.testing.assert_allclose(closed.extents, spec.size, atol=1e-4)
    np.testing.assert_allclose(closed.bounds.mean(0), 0, atol=1e-6)
    assert len(shape.faces) <= 2500
    # Between foam and brass; steel and brass only in the padlock, wood and plastic hollow or not in the rest.
    density = spec.mass / closed.volume
    assert 300 < density < (6000 if spec.id == "padlock" else 2200)


@each
def test_uv_normals_and_file(spec, tmp_path):
    shape, mesh = built(spec.id)
    assert shape.texture_size <= 512 and shape.uv.min() >= 0 and shape.uv.max() <= 1
    corners = shape.vertices[shape.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    large = np.linalg.norm(flat, axis=1) > 1e-8
    assert (np.einsum("fi,fci->fc", flat, shape.normals[shape.faces])[large] > 0).all()
    uv = shape.uv[shape.faces]
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    areas = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    assert 0.25 < areas.sum() < 1  # a fair part of the texture is used, and no triangle shares its place with another
    write_glb(mesh, tmp_path / "a.glb")
    assert (tmp_path / "a.glb").stat().st_size < 115_000


@each
def test_pieces_fill_the_body(spec):
    shape = built(spec.id)[0]
    closed, pieces = shape.closed(), list(shape.pieces)
    assert 1 <= len(pieces) <= 24
    assert max(map(len, pieces)) <= 38 and max(map(flat_faces, pieces)) <= GPU_LIMIT
    if not spec.hollow:
        assert volume_iou(closed, pieces) >= 0.88
    points = trimesh.sample.sample_surface(closed, 4000, seed=0)[0]
    corners = [trimesh.sample.sample_surface(trimesh.convex.convex_hull(p), 3000, seed=0)[0] for p in pieces]
    distance = KDTree(np.concatenate(corners)).query(points)[0]
    assert distance.mean() < 0.0025


@pytest.mark.parametrize(
    "names", [QUICK, pytest.param(set(IDS) - QUICK, marks=pytest.mark.slow)], ids=["quick", "rest"]
)
def test_pieces_are_cooked_as_they_are(names, tmp_path):
    for name in names:
        (tmp_path / name).mkdir()
        write_hulls(tmp_path / name / HULLS, list(built(name)[0].pieces))
    assert cooking_faults(tmp_path) == []


@pytest.mark.parametrize("name", sorted(QUICK))
def test_can_be_grasped(name):
    """The others as they are shipped: test_builtin_pack."""
    closed = built(name)[0].closed()
    grasps = sample_grasps(closed, np.asarray(closed.center_mass), np.random.default_rng(0), count=100)
    assert len(grasps) >= 50


@each
def test_stands(spec):
    """What touches level ground lies around the centre of mass; a ball and what lies along its length may roll."""
    closed = built(spec.id)[0].closed()
    low = closed.vertices[closed.vertices[:, 2] < closed.bounds[0, 2] + 1.5e-3]
    foot = MultiPoint(low[:, :2]).convex_hull.buffer(2e-3)
    assert foot.contains(Point(closed.center_mass[:2]))


def test_holes_are_open():
    lock = built("padlock")[0].closed()
    # Shackle: legs 28 mm apart, 8.4 mm thick; below it the body, whose top is at 46 of 75 mm.
    assert not lock.contains([[0, 0, 0.020], [0.006, 0, 0.015], [0, 0.01, 0.02]]).any()
    assert lock.contains([[0.014, 0, 0.015], [-0.014, 0, 0.015], [0, 0, 0.0355], [0, 0, -0.01]]).all()
    assert lock.euler_number == 0  # one hole
    scissors = built("scissors")[0].closed()
    rings = np.array([[-0.066, 0.0245, 0], [-0.066, -0.0235, 0], [-0.08, 0.0245, 0], [-0.055, -0.0235, 0]])
    assert not scissors.contains(rings).any()
    assert scissors.contains([[0, 0, 0], [0.03, 0.0005, 0.0015], [-0.03, 0, 0]]).sum() >= 2
    assert scissors.euler_number == -2  # two rings, nothing else
    for point in rings:  # nor does any collision piece close them
        assert not any(trimesh.convex.convex_hull(p).contains([point])[0] for p in built("scissors")[0].pieces)


@pytest.mark.slow
def test_biplane_has_room_between_its_wings():
    shape = built("toy_airplane_k")[0]
    gap = [[0.015, 0.025, 0.010], [0.015, -0.025, 0.010]]
    assert not shape.closed().contains(gap).any()
    assert not any(trimesh.convex.convex_hull(p).contains(gap).any() for p in shape.pieces)


@pytest.mark.parametrize(
    ("name", "colours"),
    [
        ("padlock", [(190, 146, 62), (165, 168, 174)]),
        ("scissors", [(200, 35, 33), (176, 180, 186)]),
        ("small_elephant", [(138, 180, 208), (238, 166, 184), (240, 240, 238)]),
        ("racquetball", [(24, 78, 190), (240, 244, 250)]),
        ("rubiks_cube", [*STICKERS.values(), (16, 16, 18)]),
    ],
)
def test_colours_are_there(name, colours):
    pixels = picture(name)
    for colour in colours:
        assert share_near(pixels, colour) > 0.004
    assert share_near(pixels, (255, 0, 255)) == 0


def test_cube_is_solvable_and_scrambled():
    faces = scrambled()
    flat = [colour for face in faces.values() for colour in face]
    assert all(flat.count(colour) == 9 for colour in STICKERS.values())
    assert all(len(set(face)) >= 3 for face in faces.values())
    solved = scrambled(())
    assert all(face == [STICKERS[name]] * 9 for name, face in solved.items())
    # A quarter turn about +x takes up (+z) from the front (-y): its right column shows what was at the bottom (-z).
    turned = scrambled(((0, 1, 3),))
    assert turned["right"] == solved["right"]
    columns = {name: {turned[name][i] for i in (2, 5, 8)} for name in ("front", "top")}
    assert columns == {"front": {STICKERS["bottom"]}, "top": {STICKERS["front"]}}


def test_same_bytes_twice(tmp_path):
    files = []
    for i in range(2):
        _, mesh = products()["padlock"].build()
        write_glb(mesh, tmp_path / f"{i}.glb")
        files.append((tmp_path / f"{i}.glb").read_bytes())
    assert files[0] == files[1]


def test_volumes_by_hand():
    """A ball, a capsule, a cylinder and a plate, against their formulas."""
    low, high = (-22.0, -22.0, -22.0), (22.0, 22.0, 22.0)

    def volume(field):
        return blends.mesh_of(field, low, high, step=0.5, triangles=4000).volume

    assert volume(blends.ellipsoid((1, 2, 3), (10, 10, 10))) == pytest.approx(4 / 3 * np.pi * 1000, rel=0.01)
    assert volume(blends.chain((-8, 0, 0, 5), (8, 0, 0, 5))) == pytest.approx(np.pi * 25 * (16 + 20 / 3), rel=0.01)
    assert volume(blends.cylinder("y", (0, 0, 0), 20, 8)) == pytest.approx(np.pi * 64 * 20, rel=0.015)
    assert volume(blends.turned("x", (0, 0, 0), [(-10, 8), (10, 8)])) == pytest.approx(np.pi * 64 * 20, rel=0.015)
    triangle = [(-12, -9), (12, -9), (12, 9)]
    assert volume(blends.plate("z", 2, 6, triangle)) == pytest.approx(24 * 18 / 2 * 6, rel=0.015)
    two = blends.both_sides(blends.box((0, 8, 0), (6, 8, 10)))
    assert volume(two) == pytest.approx(2 * 480, rel=0.02)
    holed = blends.cut(blends.box((0, 0, 0), (30, 30, 10)), blends.cylinder("z", (0, 0, 0), 20, 6))
    assert volume(holed) == pytest.approx(9000 - np.pi * 36 * 10, rel=0.015)


def test_smooth_min():
    # Equal distances: a quarter of the reach is added; farther apart than the reach: the lesser.
    np.testing.assert_allclose(
        blends.smooth_min(np.array([1.0, 1.0, 0.0]), np.array([1.0, 9.0, 2.0]), 4.0), [0.0, 1.0, -0.25]
    )
    np.testing.assert_allclose(blends.smooth_min(np.array([2.0]), np.array([1.0]), 0), [1.0])


def test_body_must_fit_its_box():
    with pytest.raises(ValueError, match="not inside"):
        blends.mesh_of(blends.ellipsoid((0, 0, 0), (10, 10, 10)), (-8, -12, -12), (12, 12, 12), step=1, triangles=500)


def test_model_says_when_its_size_is_off():
    model = Model((Part(blends.ellipsoid((0, 0, 0), (10, 10, 10)), (9, 9, 9)),), (-14, -14, -14), (14, 14, 14))
    with pytest.raises(ValueError, match="the parts give"):
        model.shape((0.02, 0.02, 0.03))


def test_paint_lands_where_it_should():
    """Colours given by position come back at each vertex's place in the texture."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    shape = unwrapped(np.asarray(ball.vertices), np.asarray(ball.faces), 128)
    image = paint_in_space(shape, lambda points, normals: 127.5 + 127.5 * points / 0.03)
    pixels = np.asarray(Image.open(io.BytesIO(_png(image))), float)
    column = np.clip(np.floor(shape.uv[:, 0] * 128), 0, 127).astype(int)
    row = np.clip(np.floor((1 - shape.uv[:, 1]) * 128), 0, 127).astype(int)
    error = np.abs(pixels[row, column] - (127.5 + 127.5 * shape.vertices / 0.03)).max(1)
    assert np.median(error) < 4 and error.max() < 30


def _png(image):
    data = io.BytesIO()
    image.save(data, "PNG")
    return data.getvalue()
