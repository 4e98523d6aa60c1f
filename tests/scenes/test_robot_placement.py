"""Valid poses of basket and robot, and randomised poses."""

import numpy as np
import pytest
from scene_models import load_scene

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.poses import from_xyz_yaw
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.robot_placement import (
    _draw_pose_near,
    is_basket_stable,
    is_body_clear,
    place_basket,
    place_robot,
)
from robocas_ms3.scenes.sample import sample_layout


def shifted(pose: np.ndarray, x: float = 0, y: float = 0, z: float = 0) -> np.ndarray:
    moved = pose.copy()
    moved[:3, 3] += x, y, z
    return moved


def test_basket_is_stable_with_support_below_its_corners():
    scene = load_scene()
    table = scene.furniture["table"].asset.surfaces["top"]
    edge = (scene.support_pose @ [*table.max_xy, 0, 1])[0]  # in x
    inner = scene.basket.asset.inner.max[0]  # from its middle to its wall
    at_edge = shifted(scene.basket_pose, x=edge - scene.basket_pose[0, 3])
    assert is_basket_stable(scene, scene.basket_pose)
    assert is_basket_stable(scene, shifted(at_edge, x=-inner))
    assert not is_basket_stable(scene, shifted(at_edge, x=-0.02))  # not with a load on the outer side
    assert not is_basket_stable(scene, shifted(at_edge, x=0.05))
    assert not is_basket_stable(scene, shifted(scene.basket_pose, z=0.1))  # in the air
    on_floor = load_scene("pick_side_table_scattered")
    assert is_basket_stable(on_floor, on_floor.basket_pose)


def test_basket_pose_over_the_edge_is_drawn_again():
    scene = load_scene(randomisation={"basket": {"position": 0.5, "yaw_deg": 20}})
    by = scene.config.randomisation.basket
    redrawn = 0
    for seed in range(8):
        first = _draw_pose_near(scene.basket_pose, by, np.random.default_rng(seed))
        pose = place_basket(scene, scene.robot_pose, np.random.default_rng(seed))
        assert is_basket_stable(scene, pose)
        redrawn += not np.array_equal(pose, first)
        if is_basket_stable(scene, first):
            np.testing.assert_array_equal(pose, first)
    assert 0 < redrawn < 8
    layout = sample_layout(scene, 1, 1)
    assert is_basket_stable(scene, layout.basket_pose)


def test_error_of_an_unstable_basket_has_the_fix():
    scene = load_scene(randomisation={"basket": {"position": 0.0}})
    air = SceneModel(**{**scene.__dict__, "basket_pose": shifted(scene.basket_pose, z=0.5)})
    with pytest.raises(LayoutError, match=r"randomisation.basket: no valid random pose.*50 poses.*Lower random"):
        place_basket(air, scene.robot_pose, np.random.default_rng(0))


def test_robot_pose_inside_furniture_is_drawn_again():
    scene = load_scene(randomisation={"robot": {"position": 0.5, "yaw_deg": 10}})
    redrawn = 0
    for seed in range(30):
        first = _draw_pose_near(scene.robot_pose, scene.config.randomisation.robot, np.random.default_rng(seed))
        pose = place_robot(scene, np.random.default_rng(seed))
        assert is_body_clear(pose, scene.furniture_points)
        redrawn += not np.array_equal(pose, first)
    assert 0 < redrawn < 30
    assert is_body_clear(sample_layout(scene, 2, 2).robot_pose, scene.furniture_points)


def test_poses_without_randomisation_stay_and_draw_nothing():
    scene, rng = load_scene(), np.random.default_rng(0)
    assert place_robot(scene, rng) is scene.robot_pose
    assert place_basket(scene, scene.robot_pose, rng) is scene.basket_pose
    assert rng.uniform() == np.random.default_rng(0).uniform()


def test_robot_body_boxes():
    root = from_xyz_yaw(1.0, 2.0, 0.0, np.pi / 2)  # ahead is +y
    for hit in ([1.0, 2.27, 0.2], [1.22, 2.0, 0.2], [1.0, 2.14, 0.6]):
        assert not is_body_clear(root, np.array([hit]))
    for beside in ([1.0, 2.29, 0.2], [1.24, 2.0, 0.2], [1.0, 2.16, 0.6], [1.0, 2.0, 0.65], [1.0, 2.0, -5.0]):
        assert is_body_clear(root, np.array([beside]))
