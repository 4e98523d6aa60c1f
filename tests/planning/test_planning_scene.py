"""What of a scene a planner sees as obstacles. No simulator."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from robocas_ms3.planning.scene import PlanningScene


class Parked(PlanningScene):
    """Three objects of one point each, 1 m apart above the basket's point; no furniture but its own point."""

    arm_base_in_world = property(lambda self: np.eye(4))
    basket_in_base = property(lambda self: np.eye(4))

    def _furniture_in_world(self, without):
        return np.array([[9.0, 0, 0]])

    def object_in_base(self, slot):
        pose = np.eye(4)
        pose[2, 3] = 1 + slot
        return pose


@pytest.mark.parametrize(
    ("present", "without", "heights"),
    [([1, 1, 1], (), [1, 2, 3]), ([1, 0, 1], (), [1, 3]), ([1, 0, 1], 2, [1]), ([0, 1, 1], [0, 1], [3])],
)
def test_objects_that_wait_elsewhere_are_no_obstacles(present, without, heights):
    point = SimpleNamespace(surface_points=lambda spacing: np.zeros((1, 3)))
    env = SimpleNamespace(
        present=torch.tensor([present], dtype=torch.bool),
        object_assets=[[point] * 3],
        model=SimpleNamespace(basket=point),
    )
    seen = Parked(env).obstacles_in_base(without=without, radius=np.inf)
    assert seen[:, 2].tolist() == [0, 0, *heights]
