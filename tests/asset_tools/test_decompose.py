"""Hulls: few, near to the body, and hollow things stay hollow."""

# trimesh types a visual as None or either of two kinds; the tests know which one they have
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false

import numpy as np
import pytest
import trimesh
from models import ball_dropped_into

from asset_tools.decompose import GPU_LIMIT, MAX_VERTICES, count_flat_faces, decompose_mesh, reduce_hull_vertices
from asset_tools.prepare import prepare_scan
from asset_tools.quality.hulls import measure_hull_quality
from robocas_ms3.assets.cooked_hulls import find_hull_violations
from robocas_ms3.assets.hulls import write_hulls
from robocas_ms3.assets.pack import HULLS

BALL = 0.012  # m


def cup(radius=0.04, height=0.1, wall=0.004, sections=64):
    """An open cup of revolution, solid walls and floor, its bottom at z = 0."""
    profile = [[0, 0], [radius, 0], [radius, height], [radius - wall, height], [radius - wall, wall], [0, wall]]
    return trimesh.creation.revolve(np.array(profile), sections=sections)


def test_a_scanned_cup_stays_hollow(tmp_path):
    mesh = cup()
    mesh.visual.vertex_colors = [200, 60, 40, 255]
    mesh.export(tmp_path / "cup.ply")
    closed = prepare_scan(tmp_path / "cup.ply", up="z").closed
    assert closed.volume == pytest.approx(mesh.volume, rel=0.02)
    found = decompose_mesh(closed)
    quality = measure_hull_quality(closed, found.hulls, hollow=True)
    assert quality.surface_p95 <= 0.004
    assert quality.hull_count <= 18
    assert (
        quality.hull_vertices <= 62 and max(map(count_flat_faces, found.hulls)) <= GPU_LIMIT
    )  # the floor's is the largest
    (tmp_path / "asset").mkdir()
    write_hulls(tmp_path / "asset" / HULLS, found.hulls)
    assert find_hull_violations(tmp_path) == []
    for x, y in ((0, 0), (0.02, 0), (-0.012, 0.012)):
        end = ball_dropped_into(tmp_path / "asset" / HULLS, [x, y, 0.13], BALL)
        assert end[2] == pytest.approx(0.004 + BALL, abs=2e-3)
        assert np.hypot(*end[:2]) < 0.04 - BALL


def test_a_can_with_rims_takes_few_hulls():
    """Recessed lids leave 0.86 to one hull; CoACD alone takes some 20 to reach 0.9."""
    rim, inner, half, deep = 0.033, 0.030, 0.04, 0.007
    profile = [[0, deep], [inner, deep], [inner, 0], [rim, 0], [rim, 2 * half], [inner, 2 * half]]
    profile += [[inner, 2 * half - deep], [0, 2 * half - deep]]
    can = trimesh.creation.revolve(np.array(profile), sections=64)
    found = decompose_mesh(can)
    assert can.volume / can.convex_hull.volume == pytest.approx(1 - 0.014 * 0.03**2 / (0.08 * 0.033**2), abs=1e-6)
    assert found.volume_iou >= 0.9
    assert 2 <= len(found.hulls) <= 10
    assert max(map(len, found.hulls)) <= MAX_VERTICES


def test_the_same_mesh_gives_the_same_hulls():
    bodies = [trimesh.creation.box([0.1, 0.02, 0.02]), trimesh.creation.box([0.02, 0.02, 0.1])]
    cross = trimesh.boolean.union(bodies)
    first, second = decompose_mesh(cross), decompose_mesh(cross)
    assert second.volume_iou == first.volume_iou
    assert all(np.array_equal(a, b) for a, b in zip(first.hulls, second.hulls, strict=True))
    assert first.volume_iou > 0.9 and len(first.hulls) <= 3


def test_few_vertices_keep_volume():
    ball = trimesh.creation.icosphere(subdivisions=4)
    kept = reduce_hull_vertices(np.asarray(ball.vertices))
    assert len(kept) == MAX_VERTICES == 34
    assert trimesh.convex.convex_hull(kept).volume == pytest.approx(ball.volume, rel=1e-6)


def test_small_bevels_are_squared_and_large_ones_kept():
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    half = np.array([0.03, 0.04, 0.05])

    def bevelled(by):
        return np.concatenate([signs * (half - by * (np.arange(3) != axis)) for axis in range(3)])

    box = reduce_hull_vertices(bevelled(0.0009))
    np.testing.assert_allclose(sorted(box.tolist()), sorted((signs * half).tolist()), atol=1e-12)
    assert len(reduce_hull_vertices(bevelled(0.004))) == 24


def test_few_flat_faces_keep_their_vertices():
    angles = np.arange(30) * 2 * np.pi / 30
    ring = 0.2 * np.stack([np.cos(angles), np.sin(angles)], axis=1)  # each corner is 4 mm outside of the others' hull
    column = np.concatenate([np.column_stack([ring, np.full(30, z)]) for z in (0.0, 0.5)])
    assert count_flat_faces(column) == 32
    assert sorted(reduce_hull_vertices(column).round(9).tolist()) == sorted(column.round(9).tolist())


def test_vertices_that_the_engine_would_drop_are_removed():
    cube = np.array([[x, y, z] for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)])
    bumps = [[0.05, 0.05, 0.1006], [0.05, 0.05, -0.0006], [0.1006, 0.05, 0.05]]
    assert len(reduce_hull_vertices(np.concatenate([cube, bumps]))) == 8
    higher = reduce_hull_vertices(np.concatenate([cube, [[0.05, 0.05, 0.102]]]))
    assert len(higher) == 9
