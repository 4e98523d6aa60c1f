"""Collision checks: point clouds, bodies, held objects, finger widths, forks and threads."""

from __future__ import annotations

import itertools
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from planning_scenes import REST, Box, cloud, corners, table_scene
from scipy.spatial.transform import Rotation

from robocas_ms3.core.poses import transform_points
from robocas_ms3.planning.collision import CollisionChecker
from robocas_ms3.planning.protocol import AttachedBody, Obstacle, Shape
from robocas_ms3.robots.description import MOBILE_PANDA


@pytest.fixture
def world(panda_files) -> CollisionChecker:
    return CollisionChecker(panda_files.arm_urdf, panda_files.arm_srdf, MOBILE_PANDA)


def test_cloud_with_5_mm_spacing_has_no_holes(world):
    """A pad 4 mm inside a plane collides everywhere; 1 cm above the plane it is free."""
    rng = np.random.default_rng(0)
    tcp = world.tcp(REST)
    lowest = tcp[:3, 3] + 0.008 * tcp[:3, 2]  # pads end 8 mm beyond the TCP
    grid = np.arange(-0.1, 0.1, 0.005)
    plane = np.stack([*(axis.ravel() for axis in np.meshgrid(grid, grid)), np.zeros(len(grid) ** 2)], axis=1)
    for _ in range(40):
        shift = np.append(rng.uniform(0, 0.005, 2), 0.0)
        # The plane is perpendicular to the approach, so that both pads touch it flat.
        world.set_scene((plane + shift + [0, 0, -0.004]) @ tcp[:3, :3].T + lowest)
        assert world.find_collisions(REST, 0.08) == ["cloud", "panda_leftfinger", "panda_rightfinger"]
        world.set_scene((plane + shift + [0, 0, 0.010]) @ tcp[:3, :3].T + lowest)
        assert world.is_free(REST[None])[0]


def test_cached_clouds_give_the_same_results(world):
    wide = cloud([Box(tuple(world.tcp(REST)[:3, 3]), (0.09, 0.09, 0.03))])
    clouds = [cloud([Box((0.6, 0, 0.1 * i), (0.1, 0.1, 0.1))]) for i in range(20)]
    for _ in range(2):
        world.set_scene(wide)
        assert not world.is_free(REST[None])[0]
        for points in clouds:
            world.set_scene(points)
            assert world.is_free(REST[None])[0]


def test_points_inside_the_base_and_out_of_reach_are_dropped(world):
    grid = np.arange(-0.5, 0.5, 0.005)
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    inside_pedestal = np.stack([x, y, np.full(len(x), -0.001)], axis=1)
    inside_pedestal = inside_pedestal[(np.abs(x) < 0.12) & (np.abs(y) < 0.09)]
    floor = np.stack([x, y, np.full(len(x), -0.49)], axis=1)  # 1 cm below the mobile base
    world.set_scene(np.concatenate([inside_pedestal, floor]))
    assert world.find_collisions(REST, 0.08) == []
    points = np.array(
        [[0, 0, -0.05], [0.05, 0, 0.1], [0.2, 0, -0.3], [0.3, 0, 0], [0, 0.2, -0.1], [1.51, 0, 0], [1.49, 0, 0]]
    )
    np.testing.assert_array_equal(world.is_obstacle_point(points), [False, False, False, True, True, False, True])


def test_points_outside_the_octree_are_ignored(world):
    """Keys of octomap have 16 bits: 327.68 m away a point has the key of a point at the TCP."""
    at_tcp = Shape(points=world.tcp(REST)[None, :3, 3] + np.array([[0, 0, 0], [0.042, 0, 0], [0, 0.042, 0]]))
    world.set_scene([Obstacle("near", at_tcp, np.eye(4))])
    assert "near" in world.find_collisions(REST, 0.0)
    far = [Shape(points=at_tcp.points + offset) for offset in ([327.68, 0, 0], [0, -327.68, 0], [0, 0, 1e300])]
    mixed = Shape(points=np.concatenate([far[0].points, [[-1, -1, -1], [0, 1, 1]]]))  # a box around all holds the arm
    world.set_scene([Obstacle("far", shape, np.eye(4)) for shape in (*far, mixed)])
    assert world.find_collisions(REST, 0.0) == []


def test_self_collisions_are_checked_without_obstacles(world):
    world.set_scene(cloud([Box(tuple(world.tcp(REST)[:3, 3]), (0.09, 0.09, 0.03))]))
    assert not world.is_free(REST[None])[0]
    assert world.is_path_free(REST[None], obstacles=False)
    folded = np.array([0.0, -1.7, 0.0, -3.0, 0.0, 0.0, 0.0])
    assert not world.is_path_free(folded[None], obstacles=False)
    assert len(world.find_collisions(folded, 0.08)) >= 2


def body(box: Box) -> Obstacle:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = box.matrix(), box.center
    return Obstacle("box", Shape((corners(*(np.array(box.size) / 2)),)), pose)


def test_bodies_and_their_clouds_give_the_same_results(world):
    """Random configurations over a table of boxes give the results of an FCL octree, within the margin."""
    boxes = table_scene(0)
    low, high = world.chain.lower, world.chain.upper
    qpos = np.clip(REST + np.random.default_rng(0).normal(0, 0.6, (400, 7)), low, high)
    world.set_scene(cloud(boxes))
    by_points = world.is_free(qpos)
    world.set_scene([body(box) for box in boxes])
    by_bodies = world.is_free(qpos)
    assert 20 < np.sum(~by_bodies) < 380
    assert np.mean(by_points == by_bodies) > 0.98
    assert [world.is_path_free(q[None]) for q in qpos] == by_bodies.tolist()
    first = int(np.argmin(by_bodies))
    assert world.count_leading_free(qpos) == first
    assert world.count_leading_free(qpos[by_bodies]) == by_bodies.sum()
    assert not world.is_path_free(qpos)
    assert world.is_path_free(qpos[by_bodies])


def check_configurations(panda_files) -> bytes:
    """Return the results of a separate checker for the same configurations, obstacles and held object."""
    world, boxes = CollisionChecker(panda_files.arm_urdf, panda_files.arm_srdf, MOBILE_PANDA), table_scene(0)
    qpos = REST + np.random.default_rng(0).uniform(-0.8, 0.8, (300, 7))
    found = []
    for obstacles in (cloud(boxes), [body(box) for box in boxes]):
        world.set_scene(obstacles) if isinstance(obstacles, np.ndarray) else world.set_scene(obstacles)
        for held in (None, AttachedBody(corners(0.05, 0.05, 0.1), np.eye(4))):
            world.attach(held)
            found.append(world.is_free(qpos))
    assert 0.1 < np.mean(found) < 0.9
    return np.array(found).tobytes()


def test_checkers_in_threads_and_forks_give_the_same_results(panda_files):
    here = check_configurations(panda_files)
    with ThreadPoolExecutor(4) as pool:
        assert set(pool.map(check_configurations, [panda_files] * 4)) == {here}
    with ProcessPoolExecutor(1, get_context("fork")) as pool:
        assert pool.submit(check_configurations, panda_files).result() == here


def test_all_obstacles_with_a_common_shape_are_checked(world):
    """The next scene reuses the same FCL objects at other positions."""
    cube, tcp = Shape((corners(0.02, 0.02, 0.02),)), world.tcp(REST)
    near, far = np.eye(4), np.eye(4)
    near[:3, 3], far[:3, 3] = tcp[:3, 3], (0.6, 0.5, 0.8)
    for _ in range(2):
        world.set_scene([Obstacle("far", cube, far), Obstacle("near", cube, near), Obstacle("also near", cube, near)])
        assert {"near", "also near"} == {name for name in world.find_collisions(REST, 0.0) if "panda" not in name}
        world.set_scene([Obstacle("near", cube, far), Obstacle("far", cube, near)])
        assert {"far"} == {name for name in world.find_collisions(REST, 0.0) if "panda" not in name}


def test_broad_phase_misses_no_contact(world, monkeypatch):
    """The results equal those of checking all pairs of parts and obstacles."""

    def everything(self, rotations, positions, width, obstacles):
        rows, moving = range(rotations.shape[1]), self._moving
        links = np.array([*itertools.product(rows, range(len(self._pairs)))])
        return links, np.array([*itertools.product(rows, moving, range(len(self._pieces)))])

    rng = np.random.default_rng(0)
    samples = [rng.uniform(world.chain.lower, world.chain.upper, (30, 7)), REST + rng.uniform(-0.6, 0.6, (60, 7))]
    qpos = np.concatenate(samples).clip(world.chain.lower, world.chain.upper)
    places = rng.uniform((0.2, -0.3, 0.1), (0.6, 0.3, 0.6), (8, 3))
    world.set_scene([body(Box(tuple(place), (0.1, 0.05, 0.08), yaw)) for yaw, place in enumerate(places)])
    held, pose = corners(0.04, 0.03, 0.08), np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", (0.5, 0.3, 0.7)).as_matrix(), (0, 0.01, 0.07)

    def contacts(*attached):
        world.attach(AttachedBody(*attached))
        widths = np.resize((0.0, 0.03, 0.08), len(qpos))
        return [world.find_collisions(q, width) for q, width in zip(qpos, widths, strict=True)]

    found = contacts(held, pose)
    assert 20 < sum(map(bool, found)) < 80
    assert sum("attached" in names for names in found) > 5
    assert contacts(transform_points(pose, held), np.eye(4)) == found
    monkeypatch.setattr(CollisionChecker, "_broad_phase", everything)
    assert contacts(held, pose) == found
