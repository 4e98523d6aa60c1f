"""Choice of the target in hand-made scenes."""

from types import SimpleNamespace

import numpy as np
import pytest

from robocas_ms3.scenes import targets
from robocas_ms3.scenes.targets import SettledScene, choose_target


@pytest.fixture
def make_scene(monkeypatch):
    """Make scenes of objects at (x, y) in the robot's frame, which equals the world frame."""

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
        monkeypatch.setattr(targets, "load_visual_mesh", lambda asset: asset)
        monkeypatch.setattr(SettledScene, "has_free_grasps", lambda self, slot: slot not in blocked)
        monkeypatch.setattr(SettledScene, "has_uncovered_grasps", lambda self, slot: slot not in flat)
        assets = [SimpleNamespace(asset=SimpleNamespace(name=name, grasp_count=grasps)) for name in names]
        return SettledScene(model, assets, poses, everything, everything, np.eye(4), np.eye(4))

    return make


def drawn(scene: SettledScene) -> set:
    choices = [choose_target(np.random.default_rng(seed), scene) for seed in range(30)]
    return {(choice.slot, choice.relation) if choice else None for choice in choices}


def fraction_of_first(scene: SettledScene) -> float:
    return np.mean([choose_target(np.random.default_rng(seed), scene).slot == 0 for seed in range(400)])


@pytest.mark.parametrize(("task", "rules"), [("pick", {}), ("open_pick", {}), ("select", {"relations": []})])
def test_nearest_object_of_a_name_is_the_target(make_scene, task, rules):
    names, places = ["apple", "apple", "mug"], [(0.52, 0.0), (0.5, 0.0), (0.5, 0.3)]
    assert drawn(make_scene(task, names, places, **rules)) == {(1, ""), (2, "")}
    # the nearer apple can't be grasped, but "the apple" would mean it
    assert drawn(make_scene(task, names, places, blocked=[1], **rules)) == {(2, "")}


def test_far_objects_and_those_with_few_grasps_are_no_targets(make_scene):
    assert drawn(make_scene("pick", ["apple", "mug"], [(0.79, 0.0), (0.7, 0.4)])) == {(0, "")}  # the mug: 0.806 m
    assert drawn(make_scene("pick", ["apple"], [(0.5, 0)], grasps=19)) == {None}


def test_select_names_one_of_several_by_its_relation(make_scene):
    names, places = ["soap", "soap", "soap", "mug"], [(0.7, 0.1), (0.6, 0.1), (0.5, 0.1), (0.4, 0.0)]
    assert drawn(make_scene("select", names, places)) == {(2, "nearest")}
    close = [(0.7, 0.1), (0.52, 0.1), (0.5, 0.1), (0.4, 0.0)]  # differences of 2 cm are ambiguous
    assert drawn(make_scene("select", names, close)) == {None}


def test_search_target_is_hidden_and_has_a_unique_name(make_scene):
    shares = np.array([0.1, 0.2, 0.89, 0.9, 0.3])
    scene = make_scene("search", ["soap", "soap", "mug", "lemon", "pear"], [(0.5, 0.0)] * 5, shares=shares)
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
        ([], [0], 0, {(1, "")}),  # not graspable even without other objects
    ],
)
def test_search_requires_free_grasps_if_configured(make_scene, blocked, flat, min_free_grasps, expected):
    rules = {"blocked": blocked, "flat": flat, "min_free_grasps": min_free_grasps}
    assert drawn(make_scene("search", ["soap", "mug"], [(0.2, 0.0), (0.6, 0.0)], **rules)) == expected


def test_search_prefers_near_objects(make_scene):
    scene = make_scene("search", ["mug", "pear"], [(0.2, 0.0), (0.6, 0.0)])
    assert 0.68 < fraction_of_first(scene) < 0.82  # weights 5 and 1.67: 0.75


def test_search_accepts_any_object_with_equal_weight_if_configured(make_scene):
    rules = {"weight": "uniform", "min_grasps": 0, "min_free_grasps": 0, "max_distance": 2.0, "grasps": 0}
    names, places, shares = ["mug", "pear", "mug"], [(0.2, 0.0), (1.9, 0.0), (0.2, 0.1)], np.array([0.5, 1.0, 1.0])
    scene = make_scene("search", names[:2], places[:2], shares=shares[:2], **rules)
    assert drawn(scene) == {(0, "")}  # the pear is visible
    scene.model.config.target.max_visible_share = None
    assert 0.4 < fraction_of_first(scene) < 0.6
    alike = make_scene("search", names, places, shares=shares, max_visible_share=None, **rules)
    assert drawn(alike) == {(1, "")}  # mugs are not unique
