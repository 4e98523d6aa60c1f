"""Which object is the target, on arrangements put together by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from robocas_ms3.scenes import targets
from robocas_ms3.scenes.targets import SettledScene, choose_target


@pytest.fixture
def arrangement(monkeypatch):
    """Make arrangements of objects at (x, y) in the robot's frame, which is the world's."""

    def make(task, names, positions, *, blocked=(), flat=(), grasps=50, shares=0.0, **rules) -> SettledScene:
        known = {"min_grasps": 20, "min_free_grasps": 1, "max_distance": 0.8, "relations": ["nearest"]}
        target = SimpleNamespace(**{**known, "max_visible_share": 0.9, "weight": "nearness", **rules})
        model = SimpleNamespace(
            config=SimpleNamespace(task=task, target=target),
            support_pose=np.eye(4),
            support_motion=lambda *, opened: np.eye(4),
            region=SimpleNamespace(min_xy=(0.0, 0.0), max_xy=(0.2, 0.2), z=0.6),
        )
        poses = np.tile(np.eye(4), (len(names), 1, 1))
        poses[:, :2, 3] = positions
        everything = np.ones(len(names), dtype=bool)
        scenery = SimpleNamespace(visible_fractions=lambda camera: np.broadcast_to(shares, len(names)))
        monkeypatch.setattr(targets, "MeshScene", lambda meshes, poses: scenery)
        monkeypatch.setattr(targets, "object_mesh", lambda asset: asset)
        monkeypatch.setattr(SettledScene, "has_free_grasps", lambda self, slot: slot not in blocked)
        monkeypatch.setattr(SettledScene, "has_uncovered_grasps", lambda self, slot: slot not in flat)
        assets = [SimpleNamespace(asset=SimpleNamespace(name=name, grasp_count=grasps)) for name in names]
        return SettledScene(model, assets, poses, everything, everything, np.eye(4), np.eye(4))

    return make


def drawn(scene: SettledScene) -> set:
    choices = [choose_target(np.random.default_rng(seed), scene) for seed in range(30)]
    return {(choice.slot, choice.relation) if choice else None for choice in choices}


def share_of_first(scene: SettledScene) -> float:
    return np.mean([choose_target(np.random.default_rng(seed), scene).slot == 0 for seed in range(400)])


@pytest.mark.parametrize(("task", "rules"), [("pick", {}), ("open_pick", {}), ("select", {"relations": []})])
def test_among_same_named_objects_the_nearest_is_meant(arrangement, task, rules):
    names, places = ["apple", "apple", "mug"], [(0.52, 0.0), (0.5, 0.0), (0.5, 0.3)]
    assert drawn(arrangement(task, names, places, **rules)) == {(1, ""), (2, "")}
    # the nearer apple can't be grasped: "the apple" would name it all the same
    assert drawn(arrangement(task, names, places, blocked=[1], **rules)) == {(2, "")}


def test_objects_too_far_or_with_too_few_grasps_are_no_targets(arrangement):
    assert drawn(arrangement("pick", ["apple", "mug"], [(0.79, 0.0), (0.7, 0.4)])) == {(0, "")}  # the mug: 0.806 m
    assert drawn(arrangement("pick", ["apple"], [(0.5, 0)], grasps=19)) == {None}


def test_select_names_one_of_several_by_its_relation(arrangement):
    names, places = ["soap", "soap", "soap", "mug"], [(0.7, 0.1), (0.6, 0.1), (0.5, 0.1), (0.4, 0.0)]
    assert drawn(arrangement("select", names, places)) == {(2, "nearest")}
    close = [(0.7, 0.1), (0.52, 0.1), (0.5, 0.1), (0.4, 0.0)]  # 2 cm apart: which is the nearest is not clear
    assert drawn(arrangement("select", names, close)) == {None}


def test_search_wants_a_hidden_object_whose_name_is_its_own(arrangement):
    shares = np.array([0.1, 0.2, 0.89, 0.9, 0.3])
    scene = arrangement("search", ["soap", "soap", "mug", "lemon", "pear"], [(0.5, 0.0)] * 5, shares=shares)
    assert drawn(scene) == {(2, ""), (4, "")}
    choice = choose_target(np.random.default_rng(0), scene)
    assert choice is not None
    np.testing.assert_array_equal(choice.visible_fractions, shares)


@pytest.mark.parametrize(
    ("blocked", "flat", "min_free_grasps", "expected"),
    [
        ([0], [], 1, {(1, "")}),
        ([0], [], 0, {(0, ""), (1, "")}),
        ([0, 1], [], 1, {None}),
        ([], [0], 0, {(1, "")}),  # not even once it is uncovered
    ],
)
def test_search_wants_free_grasps_where_the_configuration_does(arrangement, blocked, flat, min_free_grasps, expected):
    rules = {"blocked": blocked, "flat": flat, "min_free_grasps": min_free_grasps}
    assert drawn(arrangement("search", ["soap", "mug"], [(0.2, 0.0), (0.6, 0.0)], **rules)) == expected


def test_search_prefers_near_objects(arrangement):
    scene = arrangement("search", ["mug", "pear"], [(0.2, 0.0), (0.6, 0.0)])
    assert 0.68 < share_of_first(scene) < 0.82  # weights 5 and 1.67: 0.75


def test_search_takes_any_object_and_all_alike_where_the_configuration_does(arrangement):
    rules = {"weight": "uniform", "min_grasps": 0, "min_free_grasps": 0, "max_distance": 2.0, "grasps": 0}
    names, places, shares = ["mug", "pear", "mug"], [(0.2, 0.0), (1.9, 0.0), (0.2, 0.1)], np.array([0.5, 1.0, 1.0])
    scene = arrangement("search", names[:2], places[:2], shares=shares[:2], **rules)
    assert drawn(scene) == {(0, "")}  # the pear lies open
    scene.model.config.target.max_visible_share = None
    assert 0.4 < share_of_first(scene) < 0.6
    alike = arrangement("search", names, places, shares=shares, max_visible_share=None, **rules)
    assert drawn(alike) == {(1, "")}  # there are two mugs
