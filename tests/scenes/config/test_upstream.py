"""The configurations of upstream's scenes have its numbers: those its data is made of, and those it evaluates in."""

import pytest

from robocas_ms3.scenes.config import load_task_config

FIRST, SECOND = ((0.0, -0.25), (0.3, 0.35)), ((0.0, -0.45), (0.3, 0.25))
HEAP = ((-0.05, -0.25), (0.25, 0.15))
# name: (surface in the table's frame, x and y of the robot's base, x of the basket, number of objects), metres
SCENES = {
    "pick_upstream": (FIRST, (0.7, 0.15), 0.45, 10),
    "pick_upstream_2": (SECOND, (0.7, 0.15), 1.3, 10),
    "pick_upstream_eval": (((0.0, -0.2), (0.25, 0.35)), (0.7, 0.15), 0.35, 4),
    "select_upstream": (FIRST, (0.7, 0.15), 0.35, 20),  # ten kinds, two of each
    "select_upstream_2": (SECOND, (0.7, 0.15), 1.3, 20),
    "search_upstream": (HEAP, (0.75, 0.25), 0.35, 15),
    "search_upstream_eval": (HEAP, (0.7, 0.25), 0.35, 10),
}


@pytest.mark.parametrize("name", SCENES)
def test_everything_stands_where_upstreams_does(name):
    surface, robot, basket, count = SCENES[name]
    config = load_task_config(name)
    assert config.furniture["table"].pose.model_dump() == {"position": (0.9, 1.0, 0.0), "yaw_deg": -90.0}
    assert (config.surface.min_xy, config.surface.max_xy) == surface
    assert config.robot.model_dump() == {"position": (*robot, 0.0), "yaw_deg": 90.0}
    assert config.basket.pose.position == (basket, 0.9, 0.61)
    assert config.objects.count == count
    assert config.objects.repeats == (name.split("_")[0] != "search" and "eval" not in name)
    assert config.robot_start == ("evaluation" if "eval" in name else "rest")
    assert config.language.split == "upstream"


def test_evaluation_is_of_its_objects_any_of_which_is_the_target():
    pick, search = load_task_config("pick_upstream_eval"), load_task_config("search_upstream_eval")
    assert pick.objects.ids == [12, 13, 14, 15, 16]
    assert search.objects.ids == [12, 13, 14, 15, 16, 31, 32, *range(34, 43), 44]
    for config in (pick, search):
        rules = config.target
        assert (rules.min_grasps, rules.min_free_grasps, rules.min_uncovered_grasps) == (0, 0, 0)
    assert search.target.max_visible_share is None
    assert search.target.weight == "uniform"
