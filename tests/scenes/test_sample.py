"""Layouts of the builtin pack from seeds."""

from dataclasses import replace

import numpy as np
import pytest
from scene_models import load_scene

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import ConfigError, LayoutError
from robocas_ms3.core.poses import transform_points
from robocas_ms3.scenes import sample
from robocas_ms3.scenes.config import bundled_configs, load_task_config
from robocas_ms3.scenes.layout import PARKING_HEIGHT
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.sample import draw_object_set, overlaps_basket, sample_layout


def test_objects_and_poses_have_separate_seeds():
    scene = load_scene()
    one, again, moved, other = (sample_layout(scene, *seeds) for seeds in ((4, 4), (4, 4), (4, 5), (5, 5)))
    np.testing.assert_array_equal(one.object_poses, again.object_poses)
    assert (one.object_ids, one.target) == (again.object_ids, again.target)
    assert one.object_ids == moved.object_ids == draw_object_set(scene, 4) != other.object_ids
    assert not np.allclose(one.object_poses, moved.object_poses)


def test_objects_without_a_target_are_replaced(monkeypatch):
    scene, choose, asked = load_scene(), sample.choose_target, []

    def fussy(rng, arrangement):
        asked.append(tuple(asset.asset.id for asset in arrangement.assets))
        return None if set(asked[-1]) == set(asked[0]) else choose(rng, arrangement)

    monkeypatch.setattr(sample, "choose_target", fussy)
    found = sample_layout(scene, 4, 4)
    assert asked[0] == draw_object_set(scene, 4) != found.object_ids == draw_object_set(scene, 4, 1)
    assert sample_layout(scene, 4, 5).object_ids == found.object_ids
    monkeypatch.setattr(sample, "choose_target", choose)
    assert sample_layout(scene, 4, 5, found.object_ids).object_ids == found.object_ids


def test_objects_that_do_not_fit_are_replaced(monkeypatch):
    scene, arrange, tried = load_scene(), sample._draw_poses, []

    def fussy(rng, model, assets):
        tried.append({asset.asset.id for asset in assets})
        if tried[-1] == tried[0]:
            raise LayoutError("no room", where="layout")
        return arrange(rng, model, assets)

    monkeypatch.setattr(sample, "_draw_poses", fussy)
    assert sample_layout(scene, 4, 4).object_ids == draw_object_set(scene, 4, 1)
    assert len(tried) == 2  # the function tries many times itself
    tried[:] = []
    with pytest.raises(LayoutError, match="no room"):
        sample_layout(scene, 4, 4, draw_object_set(scene, 4))


def test_objects_and_kinds_may_repeat():
    ids = {"ids": ["mug", "soap_box", "sugar_box"], "count": 4, "repeats": True}
    scattered = [draw_object_set(load_scene(objects=ids), seed) for seed in range(20)]
    assert max(chosen.count(i) for chosen in scattered for i in chosen) > 2  # without repeats it would be 2
    layout = {"kind": "orderly", "copies": 2, "rows": 2}
    for chosen in (draw_object_set(load_scene(objects=ids, layout=layout), seed) for seed in range(20)):
        assert chosen[0] == chosen[1] and chosen[2] == chosen[3]
    assert any(len(set(draw_object_set(load_scene(objects=ids, layout=layout), seed))) == 1 for seed in range(20))


def test_columns_that_do_not_fit_leave_their_slots_empty():
    scene = load_scene(
        layout={"kind": "orderly", "copies": 2, "rows": 2, "keep_what_fits": True},
        objects={"ids": "all", "count": 24},
    )
    layout = sample_layout(scene, 1, 1)
    assert len(layout.object_ids) == 24
    assert 6 <= layout.present.sum() <= 20
    assert layout.present[layout.target]
    heights = layout.object_poses[:, 2, 3]
    assert (heights[layout.present] > 0.61).all()
    assert (heights[~layout.present] < PARKING_HEIGHT + 0.3).all()
    # the layout's seed decides the order of columns, so other objects may be present
    assert sample_layout(scene, 1, 2).present.tolist() != layout.present.tolist()


@pytest.mark.parametrize("name", [name for name in bundled_configs() if "_upstream" in name])
def test_upstream_scenes_have_layouts_next_to_the_basket(name):
    scene = load_scene(name)
    region = np.array([[*scene.region.min_xy, scene.region.z], [*scene.region.max_xy, scene.region.z]])
    low, high = np.sort(transform_points(scene.support_pose, region)[:, :2], axis=0)
    walls = transform_points(scene.basket_pose, np.concatenate(scene.basket.hulls))[:, :2]
    apart = np.maximum(low - walls.max(axis=0), walls.min(axis=0) - high).max()
    assert apart > -1e-6  # in the second versions they touch
    for seed in range(2):
        layout = sample_layout(scene, seed, seed)
        used = [
            scene.object_pack.objects[i] for i, there in zip(layout.object_ids, layout.present, strict=True) if there
        ]
        assert not overlaps_basket(used, layout.object_poses[layout.present], scene.basket, layout.basket_pose)


def test_columns_exclude_objects_without_display_pose_with_one_warning(caplog):
    objects = load_pack("builtin").objects
    lying = [i for i in ("banana", "scissors", "apple") if objects[i].annotations.display_pose < 0]
    assert lying
    ids = ["mug", "soap_box", "sugar_box", *lying]
    scene = load_scene(layout={"kind": "orderly", "copies": 2, "rows": 2}, objects={"ids": ids, "count": 6})
    drawn = {i for seed in range(6) for i in draw_object_set(scene, seed)}
    assert drawn == {"mug", "soap_box", "sugar_box"}
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 1 and messages[0].endswith(": " + ", ".join(lying))
    caplog.clear()
    draw_object_set(load_scene(layout={"kind": "orderly"}), 0)  # all objects with a display pose: no warning
    assert not caplog.records


def under(height: float, **changes) -> SceneModel:
    """Return a table scene with a given headroom, m."""
    scene = load_scene(**changes)
    table = scene.furniture["table"]
    surfaces = {"top": table.asset.surfaces["top"].model_copy(update={"headroom": height})}
    return replace(
        scene, furniture={"table": replace(table, asset=table.asset.model_copy(update={"surfaces": surfaces}))}
    )


def height_of(scene: SceneModel, layout) -> float:
    """Return the height of the highest object above the surface, m."""
    objects = scene.object_pack.objects
    parts = [
        transform_points(pose, np.concatenate(objects[i].hulls))
        for i, pose in zip(layout.object_ids, layout.object_poses, strict=True)
    ]
    return np.concatenate(parts)[:, 2].max() - (scene.support_pose[2, 3] + scene.region.z)


@pytest.mark.parametrize(("kind", "room"), [("scattered", 0.07), ("orderly", 0.12)])
def test_nothing_stands_higher_than_the_headroom(kind, room):
    changes = {
        "layout": {"kind": kind},
        "objects": {"ids": ["mustard_bottle", "sugar_box", "mug"], "count": 4},
        "target": {"min_free_grasps": 0},  # this test is not about targets
    }
    free, low = load_scene(**changes), under(room, **changes)
    assert max(height_of(free, sample_layout(free, seed, seed)) for seed in range(3)) > room + 0.02
    for seed in range(3):
        layout = sample_layout(low, seed, seed)
        assert height_of(low, layout) < room + 0.003
        assert kind == "scattered" or set(layout.object_ids) == {"mug"}  # the others don't fit standing
    with pytest.raises(LayoutError, match=r"too high for the surface.*lower than 0.020 m"):
        sample_layout(under(0.02, **changes), 0, 0)


def test_counts_and_distractors_use_some_of_the_slots():
    fruit = ["apple", "lemon", "peach", "pear", "orange", "plum"]
    scene = load_scene(
        objects={"ids": ["mug", "banana", "soap_box", "padlock"], "count": 4},
        randomisation={"count": [2, 4], "distractors": {"ids": fruit, "count": [1, 3]}},
    )
    counts = set()
    for seed in range(12):
        layout = sample_layout(scene, seed, seed)
        assert len(layout.object_ids) == 7
        own, others = layout.present[:4], layout.present[4:]
        counts.add((int(own.sum()), int(others.sum())))
        assert set(layout.object_ids[4:]) <= set(fruit)
        assert layout.target < own.sum()  # never a distractor, always one that is there
        waiting = layout.object_poses[~layout.present, 2, 3]
        assert ((waiting > PARKING_HEIGHT) & (waiting < PARKING_HEIGHT + 0.3)).all()
    assert {own for own, _ in counts} == {2, 3, 4}
    assert {others for _, others in counts} == {1, 2, 3}


def test_robot_and_basket_move_within_bounds_and_leave_the_objects():
    plain = sample_layout(load_scene(), 3, 3)
    moved = sample_layout(load_scene(randomisation={"robot": {"position": 0.04, "yaw_deg": 6}, "basket": {}}), 3, 3)
    np.testing.assert_allclose(plain.object_poses, moved.object_poses, atol=1e-4)  # settled next to another basket
    shift = moved.robot_pose[:3, 3] - plain.robot_pose[:3, 3]
    assert 0 < np.abs(shift).max() <= 0.04
    assert shift[2] == 0
    turn = plain.robot_pose[:3, :3].T @ moved.robot_pose[:3, :3]
    assert 0 < np.rad2deg(abs(np.arctan2(turn[1, 0], turn[0, 0]))) <= 6
    assert not np.allclose(plain.basket_pose, moved.basket_pose)


def test_no_object_is_in_a_randomised_basket():
    moving = load_scene(randomisation={"basket": {"position": 0.25, "yaw_deg": 20}})
    for seed in (5, 6, 7):
        layout = sample_layout(moving, seed, seed)
        assets = [moving.object_pack.objects[i] for i in layout.object_ids]
        assert not overlaps_basket(assets, layout.object_poses, moving.basket, layout.basket_pose)
    inside = layout.object_poses.copy()
    inside[0, :3, 3] = layout.basket_pose[:3, 3] + [0, 0, 0.05]
    assert overlaps_basket(assets, inside, moving.basket, layout.basket_pose)


def rows(copies: int, relations: list[str] | None, count: int = 10, **objects) -> SceneModel:
    target = {} if relations is None else {"relations": relations}
    layout = {"kind": "orderly", "copies": copies}
    return load_scene("select_table_orderly", layout=layout, target=target, objects={"count": count, **objects})


@pytest.mark.parametrize("relations", [["middle"], ["nearest", "second_from_left", "second_nearest"]])
def test_relations_of_three_objects_need_three(relations):
    for wrong in ({"copies": 2}, {"copies": 3, "count": 2}):
        with pytest.raises(ConfigError, match="target.relations"):
            rows(relations=relations, **wrong)
    rows(3, relations)
    rows(2, relations, count=6, ids=["mug", "soap_box"])  # four mugs, or four boxes
    rows(2, relations, repeats=True)
    rows(2, ["nearest", "farthest", "leftmost", "rightmost"])
    rows(2, list(rows(2, None).config.target.relations))  # all relations: those that are possible


@pytest.mark.parametrize(
    ("changes", "key", "words"),
    [
        ({"randomisation": {"room": ["roof"]}}, "randomisation.room", "roof"),
        ({"randomisation": {"finishes": {"wall": ["tiles"]}}}, "randomisation.finishes", "wall"),
        (
            {"randomisation": {"room": ["wall"], "finishes": {"wall": ["tiles", "gold"]}}},
            "randomisation.finishes.wall",
            "gold",
        ),
        ({"randomisation": {"cameras": {"min_position": 0.05}}}, "min_position 0.05", "position, 0.02"),
        ({"randomisation": {"object_sets": [["spam"]]}}, "randomisation.object_sets.0", "spam"),
        ({"randomisation": {"distractors": {"ids": ["spam"]}}}, "randomisation.distractors.ids", "spam"),
        ({"randomisation": {"distractors": {"ids": []}}}, "randomisation.distractors.ids", ""),
        ({"randomisation": {"distractors": {"ids": ["mug"], "count": [3, 1]}}}, "distractors.count", "[3, 1]"),
        ({"randomisation": {"lights": {"ambient": [0.6, 0.2]}}}, "lights.ambient", "[0.6, 0.2]"),
        ({"opening": {"furniture": "table", "handle": "door"}}, "opening", "open_pick"),
        ({"objects": {"ids": [6, "aple"], "count": 2}}, "objects.ids", "Did you mean apple?"),
        ({"room": {"asset": "room", "finishes": {"wal": "plaster"}}}, "room.finishes.wal", "Did you mean wall?"),
        ({"room": {"asset": "room", "finishes": {"floor": "lava"}}}, "room.finishes.floor", "lava"),
    ],
)
def test_invalid_randomisation_blocks_are_errors(changes, key, words):
    with pytest.raises(ConfigError) as caught:
        load_scene(**changes)
    assert key in str(caught.value) and words in str(caught.value)


@pytest.mark.parametrize(
    ("name", "opening", "joints", "words"),
    [
        ("open_pick_container", {}, {"flap": 0.1}, r"no such joint.*found flap"),
        ("open_pick_container", {}, {"door_slide": 9.0}, r"door_slide: position outside of the limits.*found 9.0"),
        ("open_pick_container", {"opened_at": 0.95}, {}, r"opening.opened_at: .* joint only to 0.95"),
        ("open_pick_refrigerator", {"opened_at": 0.85}, {}, r"opened_at: .*revolute.*below 0.8, found 0.85.*Lower"),
        ("open_pick_container", {}, {"door_slide": 0.45}, "door_slide: the part to open is open at the start"),
        ("open_pick_container", {"opened_at": 0.8}, {"door_slide": 0.43}, ""),
    ],
)
def test_joints_and_openings(name, opening, joints, words):
    data = load_task_config(name).model_dump(mode="json")
    data["furniture"][data["opening"]["furniture"]]["joints"] = joints
    changes = {"furniture": data["furniture"], "opening": {**data["opening"], **opening}}
    if words:
        with pytest.raises(ConfigError, match=words):
            load_scene(name, **changes)
    else:
        assert load_scene(name, **changes).open_threshold == pytest.approx(0.44)


def test_orderly_objects_come_in_kinds():
    scene = load_scene(layout={"kind": "orderly", "copies": 3}, objects={"ids": "all", "count": 7})
    ids = draw_object_set(scene, 0)
    assert [ids.count(kind) for kind in dict.fromkeys(ids)] == [3, 3, 1]


def test_one_of_several_object_sets_is_drawn():
    sets = [["apple", "lemon", "peach"], ["mug", "banana", "padlock"]]
    scene = load_scene(objects={"ids": "all", "count": 3}, randomisation={"object_sets": sets})
    drawn = {frozenset(draw_object_set(scene, seed)) for seed in range(20)}
    assert drawn == {frozenset(one) for one in sets}
