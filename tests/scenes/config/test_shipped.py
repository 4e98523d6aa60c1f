"""Bundled configurations: numbers of RoboCAS-v0, annotations of PartNet, and hashes of all values.

`python tests/scenes/config/test_shipped.py` writes `resolved.json` again after an intended change of a value.
"""

import hashlib
import json
from pathlib import Path

import pytest

from asset_tools.partnet.annotation import find_annotation
from robocas_ms3.scenes.config import bundled_configs, load_task_config

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
def test_poses_equal_those_of_robocas_v0(name):
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


def test_evaluation_scenes_have_their_objects_and_any_target():
    pick, search = load_task_config("pick_upstream_eval"), load_task_config("search_upstream_eval")
    assert pick.objects.ids == [12, 13, 14, 15, 16]
    assert search.objects.ids == [12, 13, 14, 15, 16, 31, 32, *range(34, 43), 44]
    for config in (pick, search):
        rules = config.target
        assert (rules.min_grasps, rules.min_free_grasps, rules.min_uncovered_grasps) == (0, 0, 0)
    assert search.target.max_visible_share is None
    assert search.target.weight == "uniform"


TEMPLATES = [name for name in bundled_configs() if "partnet" in name]


@pytest.mark.parametrize("name", TEMPLATES)
def test_surfaces_handles_and_joints_are_annotated(name):
    assert "import-partnet" in bundled_configs()[name].read_text(encoding="utf-8")
    config = load_task_config(name)
    for key, item in config.furniture.items():
        pack, _, model = item.asset.rpartition("/")
        if pack != "partnet":
            continue
        annotation = find_annotation(model)
        if config.surface.furniture == key:
            surface = annotation.surfaces[config.surface.name]
            low, high = config.surface.min_xy or surface.min_xy, config.surface.max_xy or surface.max_xy
            assert all(a >= b for a, b in zip(low, surface.min_xy, strict=True))
            assert all(a <= b for a, b in zip(high, surface.max_xy, strict=True))
        if config.opening and config.opening.furniture == key:
            assert config.opening.handle in annotation.handles


STORED = Path(__file__).parent / "resolved.json"
HASHES = json.loads(STORED.read_text(encoding="utf-8"))
"""Name -> sha256 of the JSON of the resolved model without the description; furniture is built in the order of keys."""


def resolved_hash(name: str) -> str:
    return hashlib.sha256(load_task_config(name).model_dump_json(exclude={"description"}).encode()).hexdigest()


def test_each_bundled_configuration_has_a_hash():
    assert HASHES.keys() == bundled_configs().keys()


@pytest.mark.parametrize("name", sorted(HASHES))
def test_the_resolved_configuration_is_unchanged(name):
    assert resolved_hash(name) == HASHES[name]


if __name__ == "__main__":
    hashes = {name: resolved_hash(name) for name in sorted(bundled_configs())}
    STORED.write_text(json.dumps(hashes, indent=1) + "\n", encoding="utf-8")
