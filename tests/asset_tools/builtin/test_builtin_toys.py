from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from shapely import MultiPoint, Point

from asset_tools.builtin.catalogue import products
from asset_tools.decompose import GPU_LIMIT, flat_faces
from asset_tools.glb import write_glb
from asset_tools.grasps import sample_grasps
from asset_tools.quality.hulls import volume_iou

TOYS = [p for p in products().values() if p.model or p.category in ("ball", "toy")]
IDS = [spec.id for spec in TOYS]
# Built in the fast run too: one of each kind, a thin one, and those with holes. The others take seconds each.
QUICK = {"padlock", "scissors", "small_elephant", "rubiks_cube", "racquetball"}
each = pytest.mark.parametrize(
    "spec", [pytest.param(s, marks=() if s.id in QUICK else pytest.mark.slow) for s in TOYS], ids=IDS
)


@cache
def built(name):
    return products()[name].build()


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
