import numpy as np
import pytest
import trimesh

from asset_tools.builtin.furniture import basket, room, table


@pytest.mark.parametrize("piece", [table(), basket(), room()], ids=lambda piece: piece.id)
def test_pieces_are_convex_and_few(piece):
    assert 5 <= len(piece.pieces) <= 8
    for points in piece.pieces:
        hull = trimesh.convex.convex_hull(points)
        assert len(hull.vertices) == len(points) == 8 and hull.volume > 0
    assert piece.shape.uv.min() >= 0 and piece.shape.uv.max() <= 1
    assert len(piece.shape.faces) < 500 and piece.shape.texture_size <= 1024
    corners = piece.shape.vertices[piece.shape.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fi,fci->fc", normals, piece.shape.normals[piece.shape.faces]) > 0).all()


def test_table_frame():
    piece = table()
    surface = piece.shape.closed()
    assert surface.is_watertight and surface.body_count == 1
    np.testing.assert_allclose(surface.bounds, [[-0.38, -0.68, 0], [0.38, 0.68, 0.61]], atol=1e-6)
    top = piece.surfaces["top"]
    assert (top.min_xy, top.max_xy, top.z) == ((-0.38, -0.68), (0.38, 0.68), 0.61)
    assert max(points[:, 2].max() for points in piece.pieces) == pytest.approx(0.61)
    assert min(points[:, 2].min() for points in piece.pieces) == 0
    assert not surface.contains([[0, 0, 0.3]])[0]  # room for legs: it is no block
    assert piece.mass is None


def test_basket_is_a_container():
    piece = basket()
    surface = piece.shape.closed()
    assert surface.is_watertight and surface.volume > 0
    np.testing.assert_allclose(surface.bounds, [[-0.15, -0.15, -0.096], [0.15, 0.15, 0.094]], atol=1e-6)
    inner = piece.inner
    assert inner is not None
    hulls = [trimesh.convex.convex_hull(points) for points in piece.pieces]
    probes = np.random.default_rng(0).uniform(np.add(inner.min, 1e-4), np.subtract(inner.max, 1e-4), (200, 3))
    assert not any(hull.contains(probes).any() for hull in hulls)
    assert not surface.contains(probes).any()
    wall = [[0.1445, 0, 0.05], [0, -0.1445, 0.05], [-0.1445, 0, 0.05], [0, 0.1445, 0.05], [0, 0, -0.092]]
    assert np.any([hull.contains(wall) for hull in hulls], axis=0).all()


def test_basket_mass():
    piece = basket()
    center, moments = piece.mass_properties()
    assert piece.mass == 0.8
    np.testing.assert_allclose(center[:2], 0, atol=1e-9)
    assert -0.06 < center[2] < 0  # the bottom plate pulls it down
    # Between a solid cube's and a thin shell's of that size.
    assert 0.8 * (0.28**2 + 0.19**2) / 12 < moments[0] < 0.8 * (0.3**2 + 0.19**2) / 4
    assert moments[0] == pytest.approx(moments[1]) and moments[2] > moments[0]
    with pytest.raises(ValueError, match="no mass"):
        table().mass_properties()


def test_room_faces_inwards():
    piece = room()
    shape = piece.shape
    np.testing.assert_allclose([shape.vertices.min(0), shape.vertices.max(0)], [[-3, -3, 0], [3, 3, 4]], atol=1e-9)
    to_center = np.array([0, 0, 2]) - shape.vertices
    assert (np.einsum("ij,ij->i", to_center, shape.normals) > 0).all()
    assert shape.closed().volume == pytest.approx(-6 * 6 * 4)  # inside out, seen from outside
    inside = np.array([[0, 0, 0.001], [2.99, 0, 1], [0, -2.99, 1], [2.99, 2.99, 3.9]])
    outside = np.array([[0, 0, -0.001], [3.01, 0, 1], [0, -3.01, 1], [-3.01, 0, 1], [0, 3.01, 1]])
    hulls = [trimesh.convex.convex_hull(points) for points in piece.pieces]
    assert not any(hull.contains(inside).any() for hull in hulls)
    assert np.any([hull.contains(outside) for hull in hulls], axis=0).all()
