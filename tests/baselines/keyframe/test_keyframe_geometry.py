"""Point cloud, objects, height map, crops and proposals of `keyframe`."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.keyframe.free_places import HeightMap
from robocas_ms3.baselines.keyframe.grasp_proposals import compute_similarity, propose_colliding_grasps, propose_grasps
from robocas_ms3.baselines.keyframe.gripper_crops import CELL, CELLS, augment_crops, make_crops
from robocas_ms3.baselines.keyframe.network import make_inputs
from robocas_ms3.baselines.keyframe.observed_scene import (
    NARROW_RADIUS,
    WIDE_RADIUS,
    ObservedObject,
    ObservedScene,
    cluster_votes,
    find_table_height,
    is_below_camera,
    sample_pixels,
    shrink_along_view,
    unproject,
)
from robocas_ms3.baselines.keyframe.obstacles import find_middle, score_blocking, score_height

INTRINSICS = np.array([[100.0, 0, 4], [0, 100.0, 3], [0, 0, 1]])
DOWN = np.array([[0, 1, 0, 0.5], [1, 0, 0, 0.25], [0, 0, -1, 1.0], [0, 0, 0, 1]])  # a camera that looks down from 1 m


def make_box(size=(0.04, 0.06, 0.05), center=(0.6, 0.0), bottom=0.1, count=2000, seed=0):
    """Points on the top and the sides of a box."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    side = rng.integers(5, size=count)
    for number, (axis, value) in enumerate(((2, 0.5), (0, 0.5), (0, -0.5), (1, 0.5), (1, -0.5))):
        points[side == number, axis] = value
    return points * size + np.array([*center, bottom + size[2] / 2])


def test_points_of_a_depth_image():
    depth = np.full((6, 8), 500, np.uint16)
    depth[0, 0] = 0
    points, valid = unproject(depth, INTRINSICS, DOWN)
    # the middle of pixel (3, 4) is 0.5 pixels right of and below the principal point: 0.5 / 100 * 0.5 m = 2.5 mm
    assert np.allclose(points[3, 4], [0.5 + 0.0025, 0.25 + 0.0025, 0.5])
    assert valid.sum() == 47 and not valid[0, 0]
    some, _ = unproject(depth, INTRINSICS, DOWN, sample_pixels(depth.shape, 2, 1))
    assert some.shape == (3, 4, 3) and np.allclose(some[1, 1], points[3, 3])


def test_points_of_a_tilted_camera_are_projected_back_to_their_pixels():
    camera = np.eye(4)
    camera[:3, :3] = Rotation.from_euler("xyz", (200, 25, 40), degrees=True).as_matrix()
    camera[:3, 3] = 0.3, -0.2, 0.9
    depth = np.random.default_rng(0).integers(300, 900, (6, 8)).astype(np.uint16)
    points, _ = unproject(depth, INTRINSICS, camera)
    local = (points - camera[:3, 3]) @ camera[:3, :3]  # transposed rotation: from the base to the camera frame
    pixels = local / local[..., 2:] @ INTRINSICS.T
    assert np.allclose(1000 * local[..., 2], depth)
    assert np.allclose(pixels[..., 0], np.arange(8) + 0.5) and np.allclose(pixels[..., 1].T, np.arange(6) + 0.5)
    inputs = make_inputs(np.zeros((6, 8, 3), np.uint8), depth, INTRINSICS, camera)
    assert np.allclose(inputs[3], 3 * np.clip(points[..., 2], -0.6, 1), atol=1e-5)


def test_inputs_have_colour_height_and_depth():
    rgb = np.zeros((6, 8, 3), np.uint8)
    rgb[..., 0] = 255
    depth = np.full((6, 8), 800, np.uint16)
    depth[0, 0] = 0
    inputs = make_inputs(rgb, depth, INTRINSICS, DOWN)
    assert inputs.shape == (5, 6, 8) and inputs.dtype == np.float32
    assert np.allclose(inputs[:, 3, 4], [1, -1, -1, 3 * 0.2, 0.3])  # 0.2 m above the base, 0.8 m - 0.5
    assert np.allclose(inputs[3:, 0, 0], [3 * -0.5, -0.5])  # no measurement


def test_the_commonest_height_is_the_table():
    heights = np.concatenate([np.full(50, 0.12), np.linspace(0.13, 0.4, 40)])
    others = np.stack([np.zeros(90), np.zeros(90), heights], axis=1)
    assert find_table_height(others, np.zeros((0, 3))) == pytest.approx(0.12, abs=0.002)


def test_the_table_is_below_the_objects():
    """The commonest height is the floor of a cabinet at -0.05 m; the objects stand on a layer at 0.2 m."""
    heights = np.concatenate([np.full(900, -0.05), np.full(150, 0.2), np.linspace(0.3, 0.5, 100)])
    others = np.stack([np.zeros(1150), np.zeros(1150), heights], axis=1)
    objects = np.stack([np.zeros(100), np.zeros(100), np.linspace(0.205, 0.35, 100)], axis=1)
    assert find_table_height(others, objects) == pytest.approx(0.2, abs=0.004)
    assert find_table_height(others[:950], objects) == pytest.approx(0.2, abs=0.01)  # too few points: the lowest ones


def test_wrong_object_points_below_the_table_do_not_change_its_height():
    """A third of the object points are on the front of a cabinet, whose points have all heights."""
    others = np.zeros((6000, 3))
    others[:, 2] = np.concatenate([np.full(1000, 0.4), np.linspace(-0.1, 0.4, 5000)])
    objects = np.zeros((150, 3))
    objects[:, 2] = np.concatenate([np.linspace(0.405, 0.5, 100), np.linspace(0.1, 0.4, 50)])
    assert find_table_height(others, objects) == pytest.approx(0.4, abs=0.004)


@pytest.mark.parametrize("wrong", [0.45, 0.5])
def test_wrong_object_points_on_and_above_a_board_do_not_change_the_height_of_the_table(wrong):
    """Wrong object points are on a larger board above the objects, or 5 cm above it."""
    others, objects = np.zeros((4300, 3)), np.zeros((560, 3))
    others[:, 2] = np.concatenate([np.full(300, 0.12), np.full(4000, 0.45)])
    objects[:, 2] = np.concatenate([np.linspace(0.125, 0.22, 500), np.full(60, wrong)])
    assert find_table_height(others, objects) == pytest.approx(0.12, abs=0.004)


def test_of_two_layers_the_one_with_the_most_object_points_is_the_table():
    others, objects = np.zeros((1200, 3)), np.zeros((700, 3))
    others[:, 2] = np.concatenate([np.full(500, 0.1), np.full(700, 0.4)])
    objects[:, 2] = np.concatenate([np.linspace(0.11, 0.2, 400), np.linspace(0.41, 0.5, 300)])
    assert find_table_height(others, objects) == pytest.approx(0.1, abs=0.004)


def test_a_camera_sees_the_upper_side_below_it():
    camera = np.eye(4)
    camera[2, 3] = 0.3
    assert is_below_camera(np.array([[1.0, 0, 0.25], [1, 0, 0.29], [1, 0, 0.4]]), camera).tolist() == [
        True,
        False,
        False,
    ]


def test_votes_of_two_objects_make_two_groups():
    rng = np.random.default_rng(0)
    first, second = rng.normal(0, 0.005, (40, 3)), rng.normal(0, 0.005, (30, 3)) + [0.1, 0, 0]
    groups = cluster_votes(np.concatenate([first, second, [[1.0, 1, 1]]]), 5, WIDE_RADIUS)
    assert [sorted(group.tolist()) for group in groups] == [list(range(40)), list(range(40, 70))]


def test_the_narrow_radius_tells_touching_copies_apart():
    rng = np.random.default_rng(0)
    votes = np.concatenate([rng.normal(0, 0.005, (40, 3)), rng.normal(0, 0.005, (40, 3)) + [0.045, 0, 0]])
    groups = cluster_votes(votes, 5, NARROW_RADIUS)
    assert sorted(sorted(group.tolist()) for group in groups) == [list(range(40)), list(range(40, 80))]
    assert len(cluster_votes(votes, 5, WIDE_RADIUS)) == 1
    assert cluster_votes(np.zeros((0, 3)), 5, NARROW_RADIUS) == []


def test_votes_are_shrunk_along_the_view():
    camera, middle = np.array([0.5, 0, 1.2]), np.array([0.5, 0, 0.2])
    votes = middle + np.array([[0, 0, 0.1], [0, 0, -0.1], [0.02, 0, 0], [-0.02, 0, 0]])
    expected = middle + np.array([[0, 0, 0.015], [0, 0, -0.015], [0.02, 0, 0], [-0.02, 0, 0]])
    assert np.allclose(shrink_along_view(votes, camera), expected)


def test_copies_with_votes_that_are_smeared_along_the_view_are_told_apart():
    """Two copies, 4 cm apart across the view; their votes are smeared by 8 cm along the view."""
    rng, camera, count = np.random.default_rng(0), np.array([0.2, 0, 0.6]), 60
    view = np.array([0.4, 0, -0.4]) / np.hypot(0.4, 0.4)
    across = np.repeat([[0, 0.02, 0], [0, -0.02, 0]], count, axis=0)
    votes = np.array([0.6, 0, 0.2]) + across + rng.normal(0, 0.003, (2 * count, 3))
    votes += rng.uniform(-0.04, 0.04, 2 * count)[:, None] * view
    groups = cluster_votes(shrink_along_view(votes, camera), 5, NARROW_RADIUS)
    assert sorted(sorted(group.tolist()) for group in groups) == [list(range(count)), list(range(count, 2 * count))]
    assert len(cluster_votes(votes, 5, NARROW_RADIUS)) > 2


def test_free_squares_are_empty_and_observed():
    heights = HeightMap()
    x, y = np.meshgrid(np.arange(0.405, 0.6, 0.01), np.arange(-0.095, 0.1, 0.01))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.12)], axis=1)
    heights.update(points)
    squares = heights.find_free_squares(0.12, 5)
    assert len(squares) == 36 and np.allclose(squares.mean(axis=0), [0.5, 0], atol=1e-6)
    heights.update(np.array([[0.5, 0.0, 0.2]]))  # an object in the middle
    assert np.abs(heights.find_free_squares(0.12, 5) - [0.51, 0.01]).max(axis=1).min() > 0.05


def test_free_places_keep_their_distances():
    heights = HeightMap()
    x, y = np.meshgrid(np.arange(0.3, 0.9, 0.01), np.arange(-0.4, 0.4, 0.01))
    heights.update(np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.12)], axis=1))
    focus, near = np.array([0.6, 0.0]), np.array([0.6, -0.3])
    places = heights.find_free_places(0.12, near, [(focus, 0.16)])
    assert 0 < len(places) <= 20 and (np.linalg.norm(places - focus, axis=1) > 0.16).all()
    distances = np.linalg.norm(places - near, axis=1)
    assert (np.diff(distances) >= 0).all() and distances[0] < 0.05
    assert not len(heights.find_free_places(0.12, near, [(focus, 2.0)]))


def test_crop_shows_the_surface_in_the_tcp_frame():
    grasp = np.eye(4)
    grasp[:3, :3] = Rotation.from_euler("x", np.pi).as_matrix()  # approach down
    grasp[:3, 3] = 0.6, 0, 0.15
    points = np.array([[0.601, -0.001, 0.17], [0.601, -0.001, 0.13], [0.601 + 5 * CELL, -0.001, 0.12]])
    crops, poses = make_crops(points, np.array([0.25, 1.0, 0.5]), grasp[None], 0.12)
    middle = CELLS // 2
    assert crops.shape == (1, 3, CELLS, CELLS) and crops[0, 1].sum() == 2
    assert crops[0, :, middle, middle] == pytest.approx([-0.2, 1, 0.25])  # the point nearest to the palm, 2 cm before
    assert crops[0, :, middle + 5, middle] == pytest.approx([0.3, 1, 0.5])
    assert poses[0, :3] == pytest.approx([-1, 0, 0.03 * 8], abs=1e-6)


@given(st.integers(0, 1000))
def test_augmentation_moves_no_more_than_a_cell(seed):
    crops = np.zeros((2, 3, CELLS, CELLS), np.float32)
    crops[:, 1, 10:30, 10:30] = 1
    poses = np.ones((2, 8), np.float32)
    found, changed = augment_crops(crops, poses, np.random.default_rng(seed))
    assert found.shape == crops.shape and crops[:, 1].sum() == 800
    assert found[:, 1, 12:28, 12:28].mean() > 0.9 and not found[:, 1, :8].any()
    assert np.allclose(np.abs(changed), 1)


def test_both_fingers_stay_above_the_table():
    points, table = make_box(size=(0.04, 0.05, 0.03)), 0.1
    grasps = propose_grasps(points, np.ones(len(points), bool), table, 500, np.random.default_rng(0)).tcp_in_base
    tips = np.array([[x, side * y, 0.0085] for x in (-0.01, 0.01) for side in (-1, 1) for y in (0.04, 0.046)])
    heights = grasps[:, 2, 3, None] + grasps[:, 2, :3] @ tips.T
    assert len(grasps) > 30 and heights.min() > table


def test_similarity_of_grasps():
    other = np.eye(4)
    other[:3, 3] = 0.5, 0.1, 0.2
    grasps = np.stack([other] * 5)
    grasps[1, 0, 3] += 0.02
    grasps[2] = other @ np.diag([-1, -1, 1, 1])  # half a turn about the approach axis
    grasps[3, :3, :3] = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    grasps[4, :3, :3] = Rotation.from_euler("z", 45, degrees=True).as_matrix()
    assert compute_similarity(grasps, other) == pytest.approx([1, np.exp(-1), 1, 1, 0])


def test_grasps_of_a_box_are_across_its_sides():
    points = make_box()
    rng = np.random.default_rng(1)
    found = propose_colliding_grasps(points, 0.1, 200, rng)
    assert 20 < len(found.heuristic) <= 200
    best = found.tcp_in_base[found.heuristic.argmax()]
    assert np.allclose(best[:2, 3], [0.6, 0], atol=0.012)  # near the middle
    tip = found.tcp_in_base[:, 2, 3] + 0.0085 * found.tcp_in_base[:, 2, 2]
    assert tip.min() > 0.1  # above the table
    assert np.allclose(np.linalg.det(found.tcp_in_base[:, :3, :3]), 1)


def test_no_grasp_of_too_few_points():
    assert not len(propose_colliding_grasps(make_box(count=10), 0.1, 100, np.random.default_rng(0)).heuristic)


def test_grasps_from_the_front_are_outward_and_above_the_surface():
    points, rng = make_box(size=(0.04, 0.06, 0.15)), np.random.default_rng(3)
    found = propose_grasps(points, np.ones(len(points), bool), 0.1, 400, rng, from_front=True)
    approach = found.tcp_in_base[:, :3, 2]
    assert len(found.heuristic) > 10
    assert (approach[:, 0] > 0.3).all() and np.abs(approach[:, 2]).max() < np.cos(np.deg2rad(34))
    # the hand is 2 x 3 cm thick along the TCP's x axis, which is almost vertical in horizontal approaches
    flat = approach[:, 2] > -0.2
    assert flat.any() and found.tcp_in_base[flat, 2, 3].min() > 0.12


def test_grasps_touch_no_neighbour():
    box, wall = make_box(), make_box((0.3, 0.02, 0.2), center=(0.6, 0.045))
    points, is_object = np.concatenate([box, wall]), np.arange(4000) < 2000
    alone = propose_grasps(box, np.ones(2000, bool), 0.1, 200, np.random.default_rng(2))
    beside = propose_grasps(points, is_object, 0.1, 200, np.random.default_rng(2))
    assert 0 < len(beside.heuristic) < len(alone.heuristic)
    closing = np.abs(beside.tcp_in_base[:, 1, 1])
    assert closing.max() < 0.8  # the fingers are not between the box and the wall


def make_scene_of(*boxes):
    """Return a scene with boxes, given as (size, center)."""
    clouds = [make_box(size, center, count=500) for size, center in boxes]
    points, owner = np.concatenate(clouds), np.repeat(np.arange(len(boxes)), 500)
    objects = [ObservedObject(owner == one, clouds[one].mean(axis=0), one, 0.9) for one in range(len(boxes))]
    return ObservedScene(points, np.ones(len(points), bool), [], objects)


def test_the_object_that_blocks_the_target_has_the_greatest_score():
    flat, tall = (0.04, 0.04, 0.03), (0.04, 0.04, 0.15)
    scene = make_scene_of((flat, (0.6, 0.0)), (tall, (0.6, 0.045)), (tall, (0.6, 0.3)))
    target, beside, far = scene.objects
    grasps = propose_colliding_grasps(scene.points[target.mask], 0.1, 200, np.random.default_rng(0)).tcp_in_base
    scores = score_blocking(scene, [beside, far], target, grasps)
    assert scores[0] > scores[1] + 1


def test_the_highest_object_in_the_middle_has_the_greatest_score():
    low, high = (0.04, 0.04, 0.03), (0.04, 0.04, 0.15)
    scene = make_scene_of((low, (0.6, 0.0)), (high, (0.6, 0.05)), (high, (0.6, 0.6)))
    assert int(np.argmax(score_height(scene, scene.objects))) == 1
    assert np.allclose(find_middle(scene), [0.6, 0.05], atol=0.02)
