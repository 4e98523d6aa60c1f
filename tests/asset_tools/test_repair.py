import numpy as np
import pytest
import trimesh

from asset_tools.repair import close_scan, compute_winding_numbers
from robocas_ms3.core.errors import AssetError

RADIUS, HEIGHT = 0.03, 0.1


@pytest.fixture
def can():
    return trimesh.creation.cylinder(RADIUS, HEIGHT, sections=48).subdivide()


def closed_volume(mesh, words):
    solid = close_scan(mesh)
    assert solid.mesh.is_watertight and solid.mesh.is_winding_consistent
    assert any(words in repair for repair in solid.repairs) or (not words and not solid.repairs)
    return solid.mesh.volume


def test_a_closed_mesh_stays_as_it_is(can):
    assert closed_volume(can, "") == pytest.approx(can.volume, rel=1e-6)


def test_inside_out_is_turned(can):
    volume = can.volume
    can.invert()
    assert closed_volume(can, "turned inside out") == pytest.approx(volume, rel=1e-6)


def test_faces_turned_at_random_are_made_consistent(can):
    turned = np.random.default_rng(0).random(len(can.faces)) < 0.3
    faces = np.where(turned[:, None], can.faces[:, ::-1], can.faces)
    mixed = trimesh.Trimesh(can.vertices, faces, process=False)
    assert closed_volume(mixed, f"turned {turned.sum()} faces outwards") == pytest.approx(can.volume, rel=1e-6)


def test_a_shell_becomes_solid(can):
    inner = trimesh.creation.cylinder(RADIUS - 0.001, HEIGHT - 0.002, sections=48)
    inner.invert()
    shell = trimesh.util.concatenate([can, inner])
    assert shell.volume < 0.1 * can.volume
    assert closed_volume(shell, "inner") == pytest.approx(can.volume, rel=1e-6)


@pytest.mark.slow
def test_a_sieve_is_remeshed(can):
    volume = can.volume
    can.update_faces(np.random.default_rng(0).random(len(can.faces)) > 0.08)
    assert closed_volume(can, "remeshed") == pytest.approx(volume, rel=0.02)


def test_a_mesh_without_volume_is_an_error():
    confetti = np.random.default_rng(0).random((300, 3))
    cap = trimesh.creation.icosphere(3)
    cap.update_faces(cap.triangles_center[:, 2] > 0.7)
    plate = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    for mesh in (plate, cap, trimesh.Trimesh(confetti, np.arange(300).reshape(-1, 3), process=False)):
        with pytest.raises(AssetError, match="the holes of the mesh are too large|cannot convert the mesh to a solid"):
            close_scan(mesh)


def test_winding_number_of_a_ball_with_and_without_a_cap():
    ball = trimesh.creation.icosphere(4)
    points = np.array([[0, 0, 0], [0, 0, 0.5], [0, 0, 3.0], [2.0, 0, 0]])
    full = compute_winding_numbers(points, ball.triangles_center, ball.face_normals, ball.area)
    np.testing.assert_allclose(full, [1, 1, 0, 0], atol=0.02)
    keep = ball.triangles_center[:, 2] < 0.6  # the missing cap covers (1 - 0.6) / 2 of the directions from the middle
    rest = compute_winding_numbers(
        points[:1], ball.triangles_center[keep], ball.face_normals[keep], ball.area_faces[keep].sum()
    )
    assert rest[0] == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize("scale", [1.0, 0.001, 1.1])
@pytest.mark.parametrize("upright", [(10, 40, 60), (10, 40, 50)])
def test_boxes_that_share_parts_of_faces_and_edges_keep_both_volumes(upright, scale):
    """A bracket of two boxes, as a file without shared vertices has it."""
    base = trimesh.creation.box((80, 40, 10))
    wall = trimesh.creation.box(upright)
    wall.apply_translation([-35, 0, upright[2] / 2 - 5])
    both = trimesh.util.concatenate([base, wall]).apply_scale(scale)
    soup = trimesh.Trimesh(both.triangles.reshape(-1, 3), np.arange(72).reshape(-1, 3), process=False)
    closed = close_scan(soup)
    assert closed.mesh.volume / scale**3 == pytest.approx(80 * 40 * 10 + 10 * 40 * (upright[2] - 10))
    np.testing.assert_allclose(closed.mesh.bounds, both.bounds)


def test_bodies_that_overlap_count_once(can):
    box = trimesh.creation.box([0.02, 0.02, 0.02])  # half of it is on the lid
    box.apply_translation([0, 0, HEIGHT / 2])
    assert closed_volume(trimesh.util.concatenate([can, box]), "") == pytest.approx(can.volume + 4e-6, rel=1e-4)


def test_faces_without_size_are_an_error():
    with pytest.raises(AssetError, match="all faces of the mesh are degenerate"):
        close_scan(trimesh.Trimesh([[0, 0, 0], [1, 0, 0]], [[0, 1, 1], [0, 0, 1]], process=False))
