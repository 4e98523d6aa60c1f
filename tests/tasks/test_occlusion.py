"""Clutter around a target, made of plates of points at known positions."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from robocas_ms3.core.poses import to_wxyz
from robocas_ms3.tasks.occlusion import (
    Clutter,
    find_push_point,
    has_clutter_moved,
    measure_clutter,
    measure_pairwise_occlusion,
    project_to_horizontal_plane,
    surface_points_in_world,
)


def plate(x: tuple[float, float], y: tuple[float, float], z: float) -> torch.Tensor:
    """Return 41 x 41 points (3, 1681) of a horizontal rectangle with limits ``x``, ``y`` at height ``z``."""
    u, v = (torch.linspace(low, high, 41) for low, high in (x, y))
    return torch.stack([*(g.flatten() for g in torch.meshgrid(u, v, indexing="ij")), torch.full((41 * 41,), z)])


TARGET = plate((-0.05, 0.05), (-0.05, 0.05), 0.65)
FAR = plate((0.3, 0.4), (0.0, 0.1), 0.8)
HIGH_ABOVE = torch.tensor([0.0, 0.0, 200.0])  # so far away that all rays are vertical


def measure_around_target(
    *others: torch.Tensor, present: list[bool] | None = None, eye: torch.Tensor = HIGH_ABOVE
) -> Clutter:
    points = torch.stack([TARGET, *others])[None]
    flags = torch.tensor([present or [True] * points.shape[1]])
    return measure_clutter(points, flags, torch.tensor([0]), eye)


def test_target_without_neighbours_is_clear():
    found = measure_around_target(FAR)
    assert found.hidden_fraction.tolist() == [0]
    assert not found.obstacles.any()
    assert found.is_target_cleared.tolist() == [True]


@pytest.mark.parametrize(("edge", "share"), [(0.0, 0.5), (0.03, 0.2), (-0.05, 1.0)])
def test_hidden_fraction_is_the_fraction_of_cells_under_a_plate(edge, share):
    found = measure_around_target(plate((edge, 0.05), (-0.05, 0.05), 0.7))
    assert found.hidden_fraction.item() == pytest.approx(share, abs=0.05)  # one row of 20 cells
    assert found.obstacles.tolist() == [[False, True]]


def test_object_nearer_to_the_camera_hides_more():
    eye = torch.tensor([0.0, 0.0, 1.15])  # 0.5 m above the target
    half_way = plate((0.0, 0.025), (-0.025, 0.025), 0.9)  # 0.25 m below the camera, so it appears at twice its size
    assert measure_around_target(half_way, eye=eye).hidden_fraction.item() == pytest.approx(0.5, abs=0.05)
    assert measure_around_target(half_way).hidden_fraction.item() == pytest.approx(0.125, abs=0.05)
    beside = torch.tensor([0.0, 0.05, 1.15])  # sees the plate from the right, so further left
    assert measure_around_target(half_way, eye=beside).hidden_fraction.item() == pytest.approx(0.25, abs=0.05)


def test_projected_points_by_hand():
    points = torch.tensor([[0.1, 0.2, 0.6], [0.1, 0.2, 0.8], [0.1, 0.2, 2.0]]).T[None, None]
    seen = project_to_horizontal_plane(points, torch.tensor([0.0, 0.1, 1.0]), torch.tensor([0.4]))
    expected = torch.tensor([[0.1, 0.1], [0.2, 0.2], [0.8, 0.8]])  # the last is above the camera: 5 cm below it
    assert torch.allclose(seen[0, 0].T, expected)


def test_object_below_the_target_hides_nothing():
    found = measure_around_target(plate((-0.05, 0.05), (-0.05, 0.05), 0.62))
    assert found.hidden_fraction.item() == 0
    assert not found.obstacles.any()


def test_higher_neighbour_within_1_cm_is_an_obstacle():
    def make_neighbour(gap: float, z: float) -> torch.Tensor:
        return plate((0.05 + gap, 0.15 + gap), (-0.05, 0.05), z)

    assert measure_around_target(make_neighbour(0.006, 0.66)).obstacles.tolist() == [[False, True]]
    assert measure_around_target(make_neighbour(0.006, 0.64)).obstacles.tolist() == [[False, False]]  # lower
    assert measure_around_target(make_neighbour(0.020, 0.66)).obstacles.tolist() == [[False, False]]  # too far
    assert measure_around_target(make_neighbour(0.006, 0.66)).hidden_fraction.item() == 0


def test_two_obstacles_are_too_many():
    right, left = plate((0.055, 0.15), (-0.05, 0.05), 0.7), plate((-0.15, -0.055), (-0.05, 0.05), 0.7)
    assert measure_around_target(right).is_target_cleared.tolist() == [True]
    assert measure_around_target(right, left).is_target_cleared.tolist() == [False]
    assert measure_around_target(right, left, present=[True, True, False]).is_target_cleared.tolist() == [True]


def test_obstacle_below_another_is_not_visible():
    low, high = plate((-0.05, 0.05), (-0.05, 0.05), 0.7), plate((-0.06, 0.06), (-0.06, 0.06), 0.75)
    assert measure_around_target(low, high).obstacles.tolist() == [[False, False, True]]


def test_envs_are_independent():
    cover = plate((-0.05, 0.05), (-0.05, 0.05), 0.7)
    points = torch.stack([torch.stack([TARGET, cover]), torch.stack([TARGET, FAR]), torch.stack([TARGET, cover])])
    found = measure_clutter(points, torch.ones(3, 2, dtype=torch.bool), torch.tensor([0, 0, 1]), HIGH_ABOVE)
    assert found.hidden_fraction.tolist() == pytest.approx([1, 0, 0])
    assert found.obstacles.tolist() == [[False, True], [False, False], [False, False]]


@settings(max_examples=20, deadline=None)
@given(x=st.floats(-1, 1), y=st.floats(-1, 1), yaw=st.floats(-math.pi, math.pi))
def test_hidden_fraction_is_invariant_to_rigid_motion(x, y, yaw):
    pose = torch.tensor([x, y, 0.1, math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)])
    points = torch.stack([TARGET, plate((0.0, 0.05), (-0.05, 0.05), 0.7)])[None]
    moved = surface_points_in_world(pose.expand(1, 2, 7), points)
    found = measure_clutter(moved, torch.ones(1, 2, dtype=torch.bool), torch.tensor([0]), HIGH_ABOVE)
    # the plate covers 10 to 12 of 20 or 21 rows of cells, since partly covered rows count
    assert found.hidden_fraction.item() == pytest.approx(0.5, abs=1.5 / 21 + 1e-3)


def test_points_follow_their_object():
    half = math.sqrt(0.5)
    pose = torch.tensor([[[1.0, 2, 3, half, 0, 0, half], [0, 0, 0, half, half, 0, 0]]])  # 90 deg about z; about x
    points = torch.tensor([[[0.1, 0, 0], [0, 0.1, 0]]])[..., None]
    moved = surface_points_in_world(pose, points)
    assert torch.allclose(moved[..., 0], torch.tensor([[[1.0, 2.1, 3], [0, 0, 0.1]]]), atol=1e-6)


def test_objects_beyond_the_motion_check_do_not_change_the_clutter():
    side = torch.linspace(-0.05, 0.05, 21)
    ball = torch.stack([x.flatten() for x in torch.meshgrid(side, side, indexing="ij")] + [torch.zeros(441)])
    ball = ball[:, torch.linalg.vector_norm(ball, dim=0) <= 0.05 + 1e-6]

    def is_obstacle_at(x: float) -> bool:
        poses = torch.tensor([[[0.0, 0, 0.7, 1, 0, 0, 0], [x, 0, 0.8, 1, 0, 0, 0]]])
        found = measure_clutter(
            surface_points_in_world(poses, ball.expand(1, 2, 3, -1)),
            torch.ones(1, 2, dtype=torch.bool),
            torch.tensor([0]),
            HIGH_ABOVE,
        )
        return bool(found.obstacles[0, 1])

    assert is_obstacle_at(0.108)
    assert not is_obstacle_at(0.1151)


def test_motion_far_away_is_ignored():
    def make_poses(*places: tuple[float, float]) -> torch.Tensor:
        return torch.tensor([[[x, y, 0.7, 1, 0, 0, 0] for x, y in places]])

    def has_moved(before: torch.Tensor, now: torch.Tensor) -> bool:
        return bool(has_clutter_moved(now, before, torch.full((1, 2), 0.05), torch.tensor([0]), HIGH_ABOVE))

    still = make_poses((0, 0), (0.11, 0))  # within two radii and three cells, along x and along y: 0.115 m
    assert not has_moved(still, still + 5e-5)
    assert has_moved(still, make_poses((0, 0), (0.1102, 0)))
    assert has_moved(make_poses((0, 0), (0.11, 0.11)), make_poses((0, 0), (0.11, 0.1102)))
    assert has_moved(still, make_poses((0.0002, 0), (0.11, 0)))  # the target
    assert not has_moved(make_poses((0, 0), (0.12, 0)), make_poses((0, 0), (0.2, 0)))
    assert has_moved(make_poses((0, 0), (0.2, 0)), make_poses((0, 0), (0.11, 0)))  # comes near
    assert has_moved(make_poses((0, 0), (0.11, 0)), make_poses((0, 0), (0.2, 0)))  # leaves


def test_push_starts_between_the_target_and_the_highest_obstacle():
    low, high = plate((0.06, 0.10), (-0.05, 0.05), 0.66), plate((-0.14, -0.06), (-0.05, 0.05), 0.7)
    points = torch.stack([TARGET, low, high, FAR])[None].repeat(3, 1, 1, 1)
    obstacles = torch.tensor([[False, True, True, False], [False, True, False, False], [False] * 4])
    found = find_push_point(points, obstacles, torch.zeros(3, dtype=torch.long))
    # 2 cm inside of the edges at x = -0.06 and 0.06; the target itself
    expected = torch.tensor([[-0.04, 0, 0.7], [0.04, 0, 0.66], [0, 0, 0.65]])
    assert torch.allclose(found, expected, atol=1e-5)


def test_push_point_of_an_obstacle_above_the_target_is_finite():
    points = torch.stack([TARGET, TARGET + torch.tensor([[0.0], [0.0], [0.1]])])[None]
    found = find_push_point(points, torch.tensor([[False, True]]), torch.tensor([0]))
    assert torch.isfinite(found).all()
    assert found[0, 2] == pytest.approx(0.75)


def test_motion_near_the_target_in_the_image_counts():
    eye, radii = torch.tensor([0.0, 0.0, 1.0]), torch.full((1, 2), 0.02)

    def has_moved(x: float, z: float) -> bool:
        before = torch.tensor([[[0.2, 0, 0.5, 1, 0, 0, 0], [x, 0, z, 1, 0, 0, 0]]])
        now = before.clone()
        now[0, 1, 0] += 1e-3
        return bool(has_clutter_moved(now, before, radii, torch.tensor([0]), eye))

    assert has_moved(0.1, 0.75)  # between camera and target
    assert not has_moved(0.1, 0.5)
    assert not has_moved(0.2, 0.75)  # above it in the world, but seen at 0.4 m from it at the target's depth


@pytest.mark.slow
def test_hidden_fractions_agree_with_ray_casting():
    from robocas_ms3.assets.pack import load_pack
    from robocas_ms3.scenes.cache import make_layout_source
    from robocas_ms3.scenes.config import load_task_config
    from robocas_ms3.scenes.model import SceneModel
    from robocas_ms3.scenes.targets import selection_camera
    from robocas_ms3.tasks.occlusion import sample_points

    pack = load_pack("builtin")
    model = SceneModel.load(load_task_config("search_table_stacked"), pack, pack)
    eye = torch.as_tensor(selection_camera(model).pose[:3, 3], dtype=torch.float32)
    differences = []
    for seed in range(3):
        layout = make_layout_source(model)(seed, seed)
        poses = torch.as_tensor(to_wxyz(layout.object_poses), dtype=torch.float32)[None]
        sampled = [sample_points(pack.objects[i].annotations.surface_points) for i in layout.object_ids]
        points = torch.as_tensor(np.array(sampled).swapaxes(1, 2), dtype=torch.float32)[None]
        count = len(sampled)
        world = surface_points_in_world(poses, points).expand(count, -1, -1, -1)
        found = measure_clutter(world, torch.ones(count, count, dtype=torch.bool), torch.arange(count), eye)
        differences += np.abs(found.hidden_fraction.numpy() - (1 - layout.visible_fractions)).tolist()
    assert len(differences) > 30
    assert np.nanmean(differences) < 0.04
    assert np.nanpercentile(differences, 95) < 0.12


def test_pairwise_occlusion_by_hand():
    """A lid hides half of the target, and a small plate hides a quarter of the lid."""
    target, lid = plate((0, 0.1), (0, 0.1), 0.5), plate((0.05, 0.15), (0, 0.1), 0.55)
    small, aside = plate((0.1, 0.15), (0, 0.05), 0.6), plate((0.4, 0.5), (0, 0.1), 0.9)
    points = torch.stack([target, lid, small, aside])[None].expand(2, -1, -1, -1)
    present = torch.tensor([[True] * 4, [True, True, False, True]])
    shares = measure_pairwise_occlusion(points, present, HIGH_ABOVE)
    wanted = torch.zeros(4, 4)
    wanted[1, 0], wanted[2, 1] = 0.5, 0.25
    torch.testing.assert_close(shares[0], wanted, atol=0.06, rtol=0)
    wanted[2, 1] = 0.0
    torch.testing.assert_close(shares[1], wanted, atol=0.06, rtol=0)
