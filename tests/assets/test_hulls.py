import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.hulls import (
    center_of_mass,
    find_box,
    make_convex_mesh,
    read_hulls,
    sample_surface,
    sample_triangles,
    slenderness,
    write_hulls,
)
from robocas_ms3.core.errors import AssetError

CUBE = np.array([[x, y, z] for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)], dtype=float)


def test_hulls_survive_writing_and_reading(tmp_path):
    write_hulls(tmp_path / "hulls.obj", [CUBE, CUBE + [0.2, 0, 0]])
    first, second = read_hulls(tmp_path / "hulls.obj")
    assert first.vertices.shape == (8, 3) and first.faces.shape == (12, 3)
    np.testing.assert_allclose(second.vertices - [0.2, 0, 0], first.vertices, atol=1e-7)
    corners = first.vertices[first.faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(0.001)  # positive: the faces look outwards


def test_coplanar_points_are_an_error():
    with pytest.raises(AssetError, match="not in one plane"):
        make_convex_mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=float))


@pytest.mark.parametrize("content", ["", "o hull_0\nv 0 0 0\nf 1 2 3\n", "v 0 0 0\nf 1 1 1\n", "o a\nv 0 zero 0\n"])
def test_damaged_hulls_name_the_file(tmp_path, content):
    path = tmp_path / "hulls.obj"
    path.write_text(content)
    with pytest.raises(AssetError, match=r"hulls\.obj"):
        read_hulls(path)


def test_grid_of_a_triangle():
    points = sample_triangles(np.array([[[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]]], dtype=float), 0.005)
    assert np.all(points >= -1e-12) and np.all(points[:, 0] + points[:, 1] <= 0.01 + 1e-12)
    for corner in ([0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]):
        assert np.linalg.norm(points - corner, axis=1).min() < 1e-9
    # The middle of the long edge is at most half a step from a point
    assert np.linalg.norm(points - [0.005, 0.005, 0], axis=1).min() <= 0.0025


def test_surface_of_a_union_has_no_inner_points(tmp_path):
    # Two cubes that overlap by half: the union is a 0.15 x 0.1 x 0.1 box
    write_hulls(tmp_path / "hulls.obj", [CUBE, CUBE + [0.05, 0, 0]])
    points = sample_surface(read_hulls(tmp_path / "hulls.obj"), 0.005)
    low, high = np.zeros(3), np.array([0.15, 0.1, 0.1])
    depth = np.minimum(points - low, high - points).min(axis=1)
    assert np.abs(depth).max() < 0.001
    # Every 5 mm of the box's surface has a point near it
    side = np.stack(np.meshgrid(np.linspace(0, 0.15, 31), np.linspace(0, 0.1, 21)), -1).reshape(-1, 2)
    top = np.column_stack([side, np.full(len(side), 0.1)])
    assert cKDTree(points).query(top)[0].max() < 0.005


def test_a_box_along_the_axes_is_not_turned():
    box = find_box(CUBE * [1, 2, 30] + [0.5, 0, -1])
    np.testing.assert_allclose(box.half_size, [0.05, 0.1, 1.5], atol=1e-12)
    np.testing.assert_allclose(box.pose[:3, 3], [0.55, 0.1, 0.5], atol=1e-12)
    np.testing.assert_array_equal(box.pose[:3, :3], np.eye(3))


@pytest.mark.parametrize("seed", range(20))
def test_find_box_for_any_orientation_and_order_of_corners(seed):
    rng = np.random.default_rng(seed)
    size, turn = rng.uniform(0.002, 1.0, 3), Rotation.random(random_state=seed).as_matrix()
    corners = np.round((CUBE / 0.1 - 0.5) * size @ turn.T + [0.3, -0.2, 0.7], 7)[rng.permutation(8)]
    box = find_box(corners)
    assert sorted(box.half_size) == pytest.approx(sorted(size / 2), abs=1e-6)
    np.testing.assert_allclose(box.pose[:3, 3], [0.3, -0.2, 0.7], atol=1e-6)
    assert np.linalg.det(box.pose[:3, :3]) == pytest.approx(1)
    found = (CUBE / 0.1 - 0.5) * 2 * box.half_size @ box.pose[:3, :3].T + box.pose[:3, 3]
    assert cKDTree(found).query(corners)[0].max() < 2e-6


def test_find_box_returns_none_for_other_shapes():
    assert find_box(CUBE[:7]) is None
    moved = CUBE.copy()
    moved[3] += [0, 0, 5e-5]  # a corner that is off by a twentieth of a millimetre
    assert find_box(moved) is None
    assert find_box(CUBE + np.outer(CUBE[:, 2], [0.1, 0, 0])) is None  # sheared
    assert find_box(CUBE * (1 - CUBE[:, 2:])) is None  # narrower at the top
    assert find_box(np.random.default_rng(0).uniform(size=(8, 3))) is None


def test_slenderness_is_reach_over_depth_from_the_centre_of_mass():
    assert slenderness(CUBE) == pytest.approx(1)
    assert slenderness(CUBE * [1, 1, 12]) == pytest.approx(12)
    # a right tetrahedron: its centre of mass is a quarter up each leg, so 3/4 from its tips and 1/4 / sqrt(3) deep
    legs = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    np.testing.assert_allclose(center_of_mass(legs), 0.25)
    assert slenderness(legs) == pytest.approx(0.75 / (0.25 / np.sqrt(3)))
