"""Every product is a closed, textured solid of its declared size, with collision pieces that fill it."""

from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from shapely import MultiPoint, Point

from asset_tools.builtin import bottles, shapes
from asset_tools.builtin.catalogue import load_builtin_products
from asset_tools.decompose import GPU_LIMIT, count_flat_faces
from asset_tools.glb import write_glb
from asset_tools.quality.hulls import compute_volume_iou

GRIPPER_OPENING = 0.08  # m
TOYS = {p.id for p in load_builtin_products().values() if p.model or p.category in ("ball", "toy")}
# Built in the fast run too: one of each kind, a thin one, and those with holes. The others take seconds each.
QUICK = {"padlock", "scissors", "small_elephant", "rubiks_cube", "racquetball"}


def parametrised(specs):
    marks = [() if spec.id in QUICK or spec.id not in TOYS else pytest.mark.slow for spec in specs]
    return pytest.mark.parametrize(
        "spec", [pytest.param(spec, marks=mark, id=spec.id) for spec, mark in zip(specs, marks, strict=True)]
    )


each = parametrised(list(load_builtin_products().values()))
each_toy = parametrised([spec for spec in load_builtin_products().values() if spec.id in TOYS])
each_household = parametrised([spec for spec in load_builtin_products().values() if spec.id not in TOYS])


@cache
def built(name):
    """Shape and textured mesh of a toy."""
    return load_builtin_products()[name].build()


@cache
def shape_of(name):
    product = load_builtin_products()[name]
    return built(name)[0] if name in TOYS else product.shape(product.size)


@each
def test_closed_and_of_the_declared_size(spec):
    shape = shape_of(spec.id)
    surface = shape.make_closed_mesh()
    assert surface.is_watertight and surface.is_winding_consistent and surface.body_count == 1
    assert surface.volume > 0
    np.testing.assert_allclose(surface.extents, spec.size, atol=1e-4)
    np.testing.assert_allclose(surface.bounds.mean(0), 0, atol=1e-6)
    assert len(shape.faces) <= (2500 if spec.id in TOYS else 6000)


@each
def test_weight(spec):
    """Toys are between foam and brass; a household's things half to one and a half times as heavy as water."""
    density = spec.mass / shape_of(spec.id).make_closed_mesh().volume
    if spec.id in TOYS:
        assert 300 < density < (6000 if spec.id == "padlock" else 2200)
    else:
        assert min(spec.size) < GRIPPER_OPENING or spec.id == "mug"  # that one is held by its wall
        assert (150 if spec.id == "chips_can" else 400) < density < 1500


@each
def test_uv_and_normals(spec):
    shape = shape_of(spec.id)
    assert shape.uv.min() >= 0 and shape.uv.max() <= 1
    np.testing.assert_allclose(np.linalg.norm(shape.normals, axis=1), 1, atol=1e-6)
    corners = shape.vertices[shape.faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    large = np.linalg.norm(face_normals, axis=1) > 1e-8
    assert (np.einsum("fi,fci->fc", face_normals, shape.normals[shape.faces])[large] > 0).all()


def uv_areas(shape):
    uv = shape.uv[shape.faces]
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


@each_household
def test_texture_is_not_mirrored(spec):
    """Seen from outside, u x v points outwards: the determinant of the map from the texture keeps its sign."""
    assert (uv_areas(shape_of(spec.id)) > -5e-10).all()


@each_toy
def test_texture_is_used_and_files_are_small(spec, tmp_path):
    shape, mesh = built(spec.id)
    assert shape.texture_size <= 512
    assert 0.25 < np.abs(uv_areas(shape)).sum() < 1  # no triangle shares its place with another
    write_glb(mesh, tmp_path / "a.glb")
    assert (tmp_path / "a.glb").stat().st_size < 115_000


@parametrised([spec for spec in load_builtin_products().values() if spec.id in TOYS or shape_of(spec.id).pieces])
def test_pieces_fill_the_shape(spec):
    shape, toy = shape_of(spec.id), spec.id in TOYS
    closed, pieces = shape.make_closed_mesh(), list(shape.pieces)
    assert 1 <= len(pieces) <= (24 if toy else 13 if spec.hollow else 8)
    assert max(map(len, pieces)) <= 48 and max(map(count_flat_faces, pieces)) <= GPU_LIMIT
    if not (toy and spec.hollow):  # for thin walls 0.1 mm is a large fraction
        assert compute_volume_iou(closed, pieces) >= (0.75 if spec.hollow else 0.88 if toy else 0.9)
    if toy:
        points = trimesh.sample.sample_surface(closed, 4000, seed=0)[0]
        corners = [trimesh.sample.sample_surface(trimesh.convex.convex_hull(p), 3000, seed=0)[0] for p in pieces]
        assert KDTree(np.concatenate(corners)).query(points)[0].mean() < 0.0025


@each_toy
def test_stands(spec):
    """Ground contacts surround the centre of mass, except for balls and objects that lie along their length."""
    closed = shape_of(spec.id).make_closed_mesh()
    low = closed.vertices[closed.vertices[:, 2] < closed.bounds[0, 2] + 1.5e-3]
    foot = MultiPoint(low[:, :2]).convex_hull.buffer(2e-3)
    assert foot.contains(Point(closed.center_mass[:2]))


def test_holes_are_open():
    lock = built("padlock")[0].make_closed_mesh()
    # Shackle: legs 28 mm apart, 8.4 mm thick; below it the body, whose top is at 46 of 75 mm.
    assert not lock.contains([[0, 0, 0.020], [0.006, 0, 0.015], [0, 0.01, 0.02]]).any()
    assert lock.contains([[0.014, 0, 0.015], [-0.014, 0, 0.015], [0, 0, 0.0355], [0, 0, -0.01]]).all()
    assert lock.euler_number == 0  # one hole
    scissors = built("scissors")[0].make_closed_mesh()
    rings = np.array([[-0.066, 0.0245, 0], [-0.066, -0.0235, 0], [-0.08, 0.0245, 0], [-0.055, -0.0235, 0]])
    assert not scissors.contains(rings).any()
    assert scissors.euler_number == -2  # two rings, nothing else
    for point in rings:  # nor does any collision piece close them
        assert not any(trimesh.convex.convex_hull(p).contains([point])[0] for p in built("scissors")[0].pieces)


def test_regions_do_not_overlap():
    for shape in (
        *(shape_of(spec.id) for spec in load_builtin_products().values() if spec.id not in TOYS),
        shapes.make_carton((0.2, 0.01, 0.1)),
        bottles.make_drink_bottle((0.05, 0.05, 0.18)),
    ):
        taken = np.zeros((shape.texture_size, shape.texture_size), dtype=int)
        for region in shape.regions.values():
            left, top, right, bottom = region.box
            assert 0 < left < right < shape.texture_size and 0 < top < bottom < shape.texture_size
            taken[top:bottom, left:right] += 1
        assert taken.max() == 1
