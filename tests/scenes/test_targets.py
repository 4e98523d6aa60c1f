"""Which object is the target, on arrangements put together by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from robocas_ms3.scenes import targets
from robocas_ms3.scenes.targets import Arrangement, choose_target


def thing(name: str, grasps: int = 50):
    return SimpleNamespace(asset=SimpleNamespace(name=name, grasp_count=grasps))


def arrangement(
    task: str, names: list[str], positions, *, monkeypatch, blocked=(), flat=(), grasps=50, **rules
) -> Arrangement:
    """Objects at (x, y) in the robot's frame, which is the world's."""
    known = {"min_grasps": 20, "min_free_grasps": 1, "max_distance": 0.8, "relations": ["nearest"]}
    target = SimpleNamespace(**{**known, "max_visible_share": 0.9, "weight": "nearness", **rules})
    config = SimpleNamespace(task=task, target=target)
    model = SimpleNamespace(config=config, support_pose=np.eye(4), support_motion=lambda *, opened: np.eye(4))
    poses = np.tile(np.eye(4), (len(names), 1, 1))
    poses[:, :2, 3] = positions
    everything = np.ones(len(names), dtype=bool)
    monkeypatch.setattr(Arrangement, "has_free_grasps", lambda self, slot: slot not in blocked)
    monkeypatch.setattr(Arrangement, "has_uncovered_grasps", lambda self, slot: slot not in flat)
    assets = [thing(name, grasps) for name in names]
    return Arrangement(model, assets, poses, everything, everything, np.eye(4), np.eye(4))


def drawn(scene: Arrangement) -> set:
    choices = [choose_target(np.random.default_rng(seed), scene) for seed in range(30)]
    return {(choice.slot, choice.relation) if choice else None for choice in choices}


@pytest.mark.parametrize("task", ["pick", "open_pick"])
def test_among_same_named_objects_the_nearest_is_meant(task, monkeypatch):
    names, places = ["apple", "apple", "mug"], [(0.7, 0.0), (0.5, 0.0), (0.5, 0.3)]
    assert drawn(arrangement(task, names, places, monkeypatch=monkeypatch)) == {(1, ""), (2, "")}
    # the nearer apple can't be grasped: "the apple" would name it all the same
    assert drawn(arrangement(task, names, places, monkeypatch=monkeypatch, blocked=[1])) == {(2, "")}


def test_objects_too_far_or_with_too_few_grasps_are_no_targets(monkeypatch):
    far = arrangement("pick", ["apple", "mug"], [(0.79, 0.0), (0.7, 0.4)], monkeypatch=monkeypatch)
    assert drawn(far) == {(0, "")}  # the mug is 0.806 m away
    assert drawn(arrangement("pick", ["apple"], [(0.5, 0)], monkeypatch=monkeypatch, grasps=19)) == {None}


def test_select_names_one_of_several_by_its_relation(monkeypatch):
    names, places = ["soap", "soap", "soap", "mug"], [(0.7, 0.1), (0.6, 0.1), (0.5, 0.1), (0.4, 0.0)]
    assert drawn(arrangement("select", names, places, monkeypatch=monkeypatch)) == {(2, "nearest")}
    close = [(0.7, 0.1), (0.52, 0.1), (0.5, 0.1), (0.4, 0.0)]  # 2 cm apart: which is the nearest is not clear
    assert drawn(arrangement("select", names, close, monkeypatch=monkeypatch)) == {None}


def test_search_wants_a_hidden_object_whose_name_is_its_own(monkeypatch):
    names, places = ["soap", "soap", "mug", "lemon", "pear"], [(0.5, 0.0)] * 5
    scene = arrangement("search", names, places, monkeypatch=monkeypatch)
    scene.model.region = SimpleNamespace(min_xy=(0.0, 0.0), max_xy=(0.2, 0.2), z=0.6)
    shares = np.array([0.1, 0.2, 0.89, 0.9, 0.3])
    monkeypatch.setattr(targets, "object_mesh", lambda asset: asset, raising=False)
    monkeypatch.setattr(targets, "visible_shares", lambda camera, meshes, poses: shares, raising=False)
    assert drawn(scene) == {(2, ""), (4, "")}
    choice = choose_target(np.random.default_rng(0), scene)
    assert choice is not None
    np.testing.assert_array_equal(choice.visible_shares, shares)


def test_search_wants_free_grasps_where_the_configuration_does(monkeypatch):
    names, places = ["soap", "mug"], [(0.2, 0.0), (0.6, 0.0)]
    scene = arrangement("search", names, places, monkeypatch=monkeypatch, blocked=[0])
    scene.model.region = SimpleNamespace(min_xy=(0.0, 0.0), max_xy=(0.2, 0.2), z=0.6)
    monkeypatch.setattr(targets, "object_mesh", lambda asset: asset)
    monkeypatch.setattr(targets, "visible_shares", lambda camera, meshes, poses: np.zeros(2))
    assert drawn(scene) == {(1, "")}
    scene.model.config.target.min_free_grasps = 0
    assert drawn(scene) == {(0, ""), (1, "")}
    everything = arrangement("search", names, places, monkeypatch=monkeypatch, blocked=[0, 1])
    everything.model.region = scene.model.region
    assert drawn(everything) == {None}


def test_search_wants_what_can_be_grasped_once_it_is_uncovered(monkeypatch):
    names, places = ["soap", "mug"], [(0.2, 0.0), (0.6, 0.0)]
    scene = arrangement("search", names, places, monkeypatch=monkeypatch, flat=[0])
    scene.model.config.target.min_free_grasps = 0
    scene.model.region = SimpleNamespace(min_xy=(0.0, 0.0), max_xy=(0.2, 0.2), z=0.6)
    monkeypatch.setattr(targets, "object_mesh", lambda asset: asset)
    monkeypatch.setattr(targets, "visible_shares", lambda camera, meshes, poses: np.zeros(2))
    assert drawn(scene) == {(1, "")}


def test_search_prefers_near_objects(monkeypatch):
    scene = arrangement("search", ["mug", "pear"], [(0.2, 0.0), (0.6, 0.0)], monkeypatch=monkeypatch)
    scene.model.region = SimpleNamespace(min_xy=(0.0, 0.0), max_xy=(0.2, 0.2), z=0.6)
    monkeypatch.setattr(targets, "object_mesh", lambda asset: asset, raising=False)
    monkeypatch.setattr(targets, "visible_shares", lambda camera, meshes, poses: np.zeros(2), raising=False)
    slots = [choose_target(np.random.default_rng(seed), scene).slot for seed in range(400)]
    assert 0.68 < slots.count(0) / 400 < 0.82  # weights 5 and 1.67: 0.75


def test_search_takes_any_object_and_all_alike_where_it_is_told_so(monkeypatch):
    rules = {"weight": "uniform", "min_grasps": 0, "min_free_grasps": 0, "max_distance": 2.0}
    names, places = ["mug", "pear", "mug"], [(0.2, 0.0), (1.9, 0.0), (0.2, 0.1)]
    scene = arrangement("search", names[:2], places[:2], monkeypatch=monkeypatch, grasps=0, **rules)
    scene.model.region = SimpleNamespace(min_xy=(0.0, 0.0), max_xy=(0.2, 0.2), z=0.6)
    monkeypatch.setattr(targets, "object_mesh", lambda asset: asset)
    monkeypatch.setattr(
        targets, "visible_shares", lambda camera, meshes, poses: np.array([0.5, 1.0, 1.0])[: len(poses)]
    )
    assert drawn(scene) == {(0, "")}  # the pear lies open
    scene.model.config.target.max_visible_share = None
    slots = [choose_target(np.random.default_rng(seed), scene).slot for seed in range(200)]
    assert 70 < slots.count(0) < 130
    alike = arrangement("search", names, places, monkeypatch=monkeypatch, grasps=0, max_visible_share=None, **rules)
    alike.model.region = scene.model.region
    assert drawn(alike) == {(1, "")}  # there are two mugs


def test_select_without_relations_means_the_nearest_of_a_name(monkeypatch):
    names, places = ["soap", "soap", "mug"], [(0.52, 0.1), (0.5, 0.1), (0.4, 0.0)]  # 2 cm apart is enough
    assert drawn(arrangement("select", names, places, monkeypatch=monkeypatch, relations=[])) == {(1, ""), (2, "")}
