"""Shapes that objects have: parts that touch, points, many small pieces, many holes; all become solids with hulls."""

# trimesh types what joining returns as any geometry
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from shapely import Polygon
from trimesh.creation import box, cone, cylinder, icosphere

from asset_tools.build import build_object
from asset_tools.decompose import adapt_hull_to_engine, decompose_mesh, reduce_hull_vertices
from asset_tools.repair import close_scan
from asset_tools.simplify import simplify_mesh
from asset_tools.sources import ObjectSource
from asset_tools.visual import make_display_mesh
from robocas_ms3.assets.cooked_hulls import MAX_SHRINKAGE, MAX_SLENDERNESS, cook_hulls, find_hull_violations


def moved(mesh, *by):
    return mesh.copy().apply_translation(by)


def joined(*meshes):
    return trimesh.util.concatenate(list(meshes))


def soup(mesh, seed=0):
    """The same triangles with vertices of their own, turned at random, in another order."""
    rng = np.random.default_rng(seed)
    corners = mesh.triangles[rng.permutation(len(mesh.faces))]
    turned = rng.random(len(corners)) < 0.5
    corners[turned] = corners[turned][:, ::-1]
    return trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)


def otherwise_divided(mesh):
    """A box with the other diagonals."""
    mirrored = mesh.copy()
    mirrored.vertices[:, 0] *= -1
    mirrored.invert()
    return mirrored


CUBE = box([0.03] * 3)
BALL = icosphere(2, 0.02)
WEDGE = trimesh.convex.convex_hull([[x, y, z] for x, y in ((0, 0), (0.05, 0.01), (0.05, -0.01)) for z in (0, 0.06)])
BOARD, SIDE, END = box([0.08, 0.08, 0.005]), box([0.005, 0.08, 0.05]), box([0.07, 0.005, 0.05])
TOUCHING = {
    "boxes": joined(box([0.06, 0.06, 0.04]), moved(box([0.06, 0.06, 0.03]), 0, 0, 0.035)),
    "boxes otherwise divided": joined(
        box([0.06, 0.06, 0.04]), moved(otherwise_divided(box([0.06, 0.06, 0.03])), 0, 0, 0.035)
    ),
    "cylinders": joined(cylinder(0.03, 0.05), moved(cylinder(0.03, 0.04), 0, 0, 0.045)),
    "can and wider lid": joined(cylinder(0.03, 0.08), moved(cylinder(0.032, 0.01), 0, 0, 0.045)),
    "needle": joined(cylinder(0.002, 0.1), moved(cone(0.002, 0.02), 0, 0, 0.05)),
    "27 cubes": joined(*[moved(CUBE, *(0.03 * np.array(at))) for at in np.ndindex(3, 3, 3)]),
    "common edge": joined(CUBE, moved(CUBE, 0.03, 0.03, 0)),
    "common vertex": joined(CUBE, moved(CUBE, 0.03, 0.03, 0.03)),
    "paddle wheel": joined(
        *[
            WEDGE.copy().apply_transform(trimesh.transformations.rotation_matrix(a, [0, 0, 1]))
            for a in np.arange(6) * np.pi / 3
        ]
    ),
    "drawer of boards": joined(
        BOARD,
        *[moved(SIDE, x, 0, 0.0275) for x in (-0.0375, 0.0375)],
        *[moved(END, 0, y, 0.0275) for y in (-0.0375, 0.0375)],
    ),
    "twice": joined(BALL, BALL),
    "thrice, with another": joined(BALL, BALL, BALL, moved(CUBE, 0, 0, 0.02)),
    "inside, on the floor": joined(box([0.06] * 3), moved(box([0.02] * 3), 0, 0, -0.02)),
    "inside, filling the lower third": joined(box([0.06] * 3), moved(box([0.06, 0.06, 0.02]), 0, 0, -0.02)),
}


def union(mesh):
    return trimesh.boolean.union(mesh.split()).volume


@pytest.mark.parametrize("name", TOUCHING)
@pytest.mark.parametrize("change", [lambda mesh: mesh, soup], ids=["as made", "soup"])
def test_parts_that_touch_become_one_solid(name, change):
    mesh = TOUCHING[name]
    solid = close_scan(change(mesh)).mesh
    assert solid.is_watertight and solid.is_winding_consistent
    assert solid.volume == pytest.approx(union(mesh), rel=1e-4)
    np.testing.assert_allclose(solid.bounds, mesh.bounds, atol=1e-6)


def test_a_single_wall_between_parts_is_also_dropped_from_the_visual_mesh():
    boxes = TOUCHING["boxes"].copy()
    boxes.merge_vertices()
    boxes.update_faces(boxes.unique_faces())
    closed = close_scan(boxes)
    assert closed.mesh.volume == pytest.approx(0.06 * 0.06 * 0.07)
    between = np.abs(closed.scan.triangles_center - [0, 0, 0.02]).max(axis=1) < 0.029
    assert not between.any()
    assert closed.scan.area == pytest.approx(2 * 0.06**2 + 4 * 0.06 * 0.07)


def test_a_fin_on_an_edge_is_dropped():
    fin = trimesh.Trimesh([[0.015, 0.015, -0.015], [0.015, 0.015, 0.015], [0.0155, 0.0155, 0]], [[0, 1, 2]])
    closed = close_scan(joined(CUBE, fin))
    assert closed.mesh.volume == pytest.approx(CUBE.volume)
    assert closed.repairs


def placed(mesh, xs, ys, z):
    return [moved(mesh, x, y, z) for x in xs for y in ys]


PEGS = placed(cylinder(0.002, 0.02, sections=10), np.linspace(-0.05, 0.05, 8), np.linspace(-0.03, 0.03, 5), 0.0129)
KEYS = placed(box([0.016, 0.016, 0.008]), np.linspace(-0.14, 0.14, 15), (-0.03, 0, 0.03), 0.0095)
BARS = placed(box([0.004, 0.2, 0.004]), 0.006 * np.arange(-30, 30), (0,), 0)
BRACES = placed(box([0.36, 0.004, 0.004]), (0,), (-0.08, 0.08), -0.003)
BRISTLES = placed(
    cylinder(0.0003, 0.025, sections=4), np.linspace(-0.07, 0.07, 30), np.linspace(-0.01, 0.01, 8), 0.0195
)
SMALL_PIECES = {
    "plate with pegs": joined(box([0.12, 0.08, 0.006]), *PEGS),
    "rack": joined(*BARS, *BRACES),
    "keyboard": joined(box([0.3, 0.1, 0.01]), *KEYS),
    "antenna": joined(box([0.1, 0.1, 0.1]), moved(cylinder(0.001, 0.1, sections=8), 0, 0, 0.1)),
    "brush": joined(box([0.15, 0.03, 0.015]), *BRISTLES),
}


@pytest.mark.parametrize("name", SMALL_PIECES)
def test_small_parts_are_kept(name):
    mesh = SMALL_PIECES[name]
    closed = close_scan(mesh)
    assert closed.repairs == ()
    assert closed.mesh.is_watertight
    assert closed.mesh.volume == pytest.approx(union(mesh), rel=0.01)
    np.testing.assert_allclose(closed.mesh.bounds, mesh.bounds, atol=1e-6)
    assert closed.scan.area == pytest.approx(mesh.area)


@pytest.mark.parametrize("far", [False, True], ids=["on it", "around it"])
def test_dirt_is_dropped_and_its_share_reported(far):
    """Crumpled scraps of four faces and closed specks, far from an object with small parts and on its surface."""
    rng = np.random.default_rng(0)
    mesh = SMALL_PIECES["plate with pegs"]
    specks = [moved(icosphere(0, 0.0005), *at) for at in rng.uniform(-0.2, 0.2, (50, 3)) if abs(at[2]) > 0.05]
    if not far:
        specks = [moved(icosphere(0, 0.0005), x, y, 0.003) for x, y in rng.uniform(-0.03, 0.03, (50, 2))]
    scrap = box([0.003] * 3)
    scrap.update_faces(np.arange(12) < 4)
    scraps = [moved(scrap, *at) for at in rng.uniform(0.15, 0.2, (20, 3))]
    closed = close_scan(joined(mesh, *specks, *scraps))
    assert closed.mesh.volume == pytest.approx(union(mesh), rel=0.01)
    np.testing.assert_allclose(closed.mesh.bounds, mesh.bounds, atol=1e-6)
    assert str(len(specks) + len(scraps)) in closed.repairs[-1] and "%" in closed.repairs[-1]


def test_pointed_parts_have_hulls():
    for mesh in (cone(0.03, 0.08), cone(0.03, 0.08, sections=200), moved(cone(0.002, 0.02), 10, 20, 30)):
        found = decompose_mesh(mesh)
        assert len(found.hulls) == 1 and found.volume_iou > 0.9
        assert trimesh.convex.convex_hull(found.hulls[0]).volume == pytest.approx(mesh.volume, rel=1e-6)


def test_small_objects_with_many_faces_have_hulls():
    """Gear of 30 mm, the flat parts of whose decomposition are left out."""
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    radius = 0.0135 + 0.0015 * np.sign(np.sin(10 * angle + 0.01))
    outline = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    gear = trimesh.creation.extrude_polygon(Polygon(outline), 0.008)
    found = decompose_mesh(close_scan(gear).mesh)
    assert found.volume_iou > 0.8


def test_slender_hulls_are_thickened_as_a_gpu_needs_it():
    disk, rod = cylinder(0.06, 0.0005, sections=16), cylinder(0.001, 0.4, sections=16)
    blade = trimesh.convex.convex_hull(
        [[0, 0, 0], [0.15, 0, 0], [0, 0.03, 0], [0.15, 0.025, 0], [0, 0, 0.002], [0.15, 0, 0.002]]
    )
    for mesh in (disk, rod, blade):
        hulls = [adapt_hull_to_engine(np.asarray(mesh.vertices))]
        (cooked,) = cook_hulls(hulls)
        assert not cooked.too_slender and cooked.shrinkage <= MAX_SHRINKAGE
        np.testing.assert_allclose(np.ptp(hulls[0], axis=0), mesh.extents, atol=0.005)
    plate = box([0.1, 0.1, 0.0002])
    assert adapt_hull_to_engine(plate.vertices) is plate.vertices and MAX_SLENDERNESS < 0.05 / 0.0001


def test_a_mesh_that_cannot_be_simplified_to_the_limit_is_taken_with_more_faces():
    posts = joined(*[moved(cylinder(0.002, 0.05, sections=6), 0.01 * i, 0.01 * j, 0) for i, j in np.ndindex(10, 10)])
    light = make_display_mesh(posts, triangles=1000)
    assert 1000 < len(light.faces) <= 6000
    np.testing.assert_allclose(light.bounds, posts.bounds, atol=1e-3)
    few = simplify_mesh(posts, 100)
    assert 0 < len(few.faces) <= 600
    np.testing.assert_allclose(few.bounds, posts.bounds, atol=5e-3)


DIE = box([0.004] * 3)


@pytest.mark.parametrize("mesh", [cone(0.03, 0.08), box([0.15, 0.1, 0.0002]), DIE], ids=["cone", "sheet", "die"])
def test_an_object_is_built(mesh, tmp_path):
    closed = close_scan(mesh)
    source = ObjectSource("thing", "thing", "scan", closed.scan, closed.mesh, 1e-4, repairs=closed.repairs)
    asset = build_object(source, tmp_path / "thing")
    assert asset.quality.rest_share >= 0.9
    assert asset.grasp_count >= 50 or asset.no_grasps_because
    assert find_hull_violations(tmp_path) == []
    if mesh is DIE:  # m a2 / 6 = 2.7e-10 kg m2: rounded to a nanounit it would have none
        assert asset.inertia == pytest.approx([1e-4 * 0.004**2 / 6] * 3, rel=1e-8)


def test_open_pegs_are_kept_since_they_are_much_of_the_surface():
    pegs = joined(*PEGS)
    pegs.update_faces(pegs.face_normals[:, 2] > -0.9)
    mesh = joined(box([0.12, 0.08, 0.006]), pegs)
    closed = close_scan(mesh)
    np.testing.assert_allclose(closed.mesh.bounds, mesh.bounds, atol=1e-6)
    assert closed.mesh.volume > 0.12 * 0.08 * 0.006 * 1.1


def test_simplifying_keeps_a_large_part_of_few_faces():
    """Edges of a box among bristles that can't be simplified are the first to collapse."""
    bristles = placed(
        cylinder(0.0006, 0.025, sections=6), np.linspace(-0.06, 0.06, 20), np.linspace(-0.01, 0.01, 8), 0.02
    )
    brush = joined(box([0.15, 0.03, 0.015]), *bristles)
    light = make_display_mesh(brush, triangles=1000)
    assert light.area == pytest.approx(brush.area, rel=0.1)
    np.testing.assert_allclose(light.bounds, brush.bounds, atol=1e-3)


def test_thin_parts_of_a_solid_survive_its_simplification():
    bristles = placed(
        cylinder(0.0003, 0.025, sections=12), np.linspace(-0.07, 0.07, 30), np.linspace(-0.01, 0.01, 8), 0
    )
    brush = joined(box([0.15, 0.03, 0.004]), *bristles)
    np.testing.assert_allclose(close_scan(brush).mesh.bounds, brush.bounds, atol=2e-4)


def test_few_vertices_of_extreme_points_in_one_plane():
    """All extreme ones along the axes and diagonals are corners of a base; the apex is next to it."""
    base = np.array([[x, y, -0.3 * (x + y)] for x in (-0.03, 0.03) for y in (-0.03, 0.03)])
    points = np.concatenate([base, base * [0.5, 0.5, 0.5] - [0, 0, 0.0005], [[0, 0, -0.004]]])
    assert trimesh.convex.convex_hull(reduce_hull_vertices(points)).volume > 0
