"""Obstacles of a scene for a planner, without a simulator."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from robocas_ms3.planning.scene import PlanningScene, to_arm_base_frame


class Parked(PlanningScene):
    """Scene of three objects with one point each, 1 m apart above the basket, and furniture with a door."""

    arm_base_in_world = property(lambda self: at(0, 0, 0))

    def joint_positions(self, furniture):
        return {}


def at(x, y, z):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def part(name):
    return SimpleNamespace(
        surface_points=lambda spacing: np.zeros((1, 3)),
        hulls=[np.zeros((4, 3))],
        asset=SimpleNamespace(id=name, links={}),
        links={},
    )


def environment(present):
    return SimpleNamespace(
        present=torch.tensor([present], dtype=torch.bool),
        object_assets=[[part(f"object {slot}") for slot in range(3)]],
        object_states=torch.tensor([[[0, 0, 1.0 + slot, 1, 0, 0, 0, *6 * [0]] for slot in range(3)]]),
        basket_pose=torch.tensor([[0, 0, 0, 1.0, 0, 0, 0]]),
        model=SimpleNamespace(
            basket=part("basket"), furniture={"table": part("table")}, furniture_poses={"table": at(9, 0, 0)}
        ),
    )


@pytest.mark.parametrize(
    ("present", "exclude", "heights"),
    [([1, 1, 1], (), [1, 2, 3]), ([1, 0, 1], (), [1, 3]), ([1, 0, 1], 2, [1]), ([0, 1, 1], [0, 1], [3])],
)
def test_absent_objects_are_no_obstacles(present, exclude, heights):
    scene = Parked(environment(present))
    assert scene.points_in_base(exclude=exclude, radius=np.inf)[:, 2].tolist() == [0, 0, *heights]
    bodies = scene.obstacles(exclude=exclude)
    assert [body.name for body in bodies[:2]] == ["table", "basket"]
    assert [body.pose_in_base[2, 3] for body in bodies[2:]] == heights


def test_clearance_applies_to_furniture_and_basket_only():
    bodies = Parked(environment([1, 1, 1])).obstacles(clearance=0.02)
    assert [(body.name, body.clearance) for body in bodies[:3]] == [
        ("table", 0.02),
        ("basket", 0.02),
        ("object 0", 0.0),
    ]


def test_points_are_limited_to_a_radius():
    scene = Parked(environment([1, 1, 1]))
    assert scene.points_in_base()[:, 2].tolist() == [0, 1]  # within 1.5 m of the arm's base
    assert scene.points_in_base(radius=0.5, around=np.array([0, 0, 2.2]))[:, 2].tolist() == [2]


def test_shapes_are_cached_and_obstacles_are_transformed_to_another_base():
    scene = Parked(environment([1, 0, 0]))
    (*_, first), (*_, again) = scene.obstacles(), scene.obstacles()
    assert first.shape is again.shape
    world = scene.obstacles_in_world()
    assert to_arm_base_frame(world, at(0.5, 0, 1))[-1].pose_in_base[:3, 3].tolist() == [-0.5, 0, 0]
