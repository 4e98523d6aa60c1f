"""Each change of ``scene.json`` or ``conversion.json`` is one violation with key, expected and found."""

import pytest
from managing import edit

from robocas_ms3.datasets.checks.dataset import validate
from robocas_ms3.datasets.checks.scene import read_valid_values
from robocas_ms3.datasets.checks.violation import check_against_model
from robocas_ms3.datasets.sources.file_models import SCENE_KEYS, SceneRecord

FILE = "episode_0000001/scene.json"
POSE = [0.5, 0.8, 0.6, 1.0, 0.0, 0.0, 0.0]
RECOVERY = {"range": [0, 4], "stage": "grasp", "reason": "slipped"}
WHOLE = {
    "schema_version": 2,
    "task": "pick",
    "env_info": {"env_id": "robocas_ms3:RoboCASPick-v1", "env_kwargs": {"pack": "builtin"}},
    "seed": 7,
    "reset_options": {},
    "config": {"task": "pick"},
    "layout": {"object_ids": ["a", "b"], "poses": [POSE, POSE], "present": [True, False], "robot_pose": POSE},
    "objects": [{"slot": 0, "id": "a", "name": "an a"}],
    "target": {"slot": 0, "asset_id": "a", "name": "an a"},
    "success": True,
    "control_mode": "pd_joint_pos",
    "control_freq": 20,
    "rate_hz": 5.0,
    "source": {"trajectory": "trajectory.h5", "episode_id": 1, "recording": "00ff"},
    "recorded": {
        "facts": {"disturbed": 0},
        "attempts": 2,
        "recoveries": [RECOVERY],
    },
    "versions": {"numpy": "1.26.4"},
}


def check_values(scene):
    return check_against_model(SceneRecord, scene, "scene.json")


def said(violation):
    return violation.key, violation.expected, violation.found


def test_complete_scene_has_no_violations():
    assert check_values(WHOLE) == []
    assert read_valid_values(WHOLE) == (WHOLE, "")


def test_unknown_values_may_be_null():
    """In imported datasets only version, rate and source are known."""
    known = {"schema_version": 2, "rate_hz": 5.0, "source": {"recording": None, "format": "upstream", "missing": []}}
    assert check_values({key: known.get(key) for key in SCENE_KEYS}) == []


def test_each_missing_key_is_a_violation():
    for key in SCENE_KEYS:
        without = {name: value for name, value in WHOLE.items() if name != key}
        assert [said(v) for v in check_values(without)] == [(key, "this key", "no such key")]
        assert read_valid_values(without) == (without, "")  # an older file, which can be shown as far as it goes


@pytest.mark.parametrize(
    ("new", "key", "expected", "found"),
    [
        ({"schema_version": 1}, "schema_version", "2", "1"),
        ({"env_info": {"env_kwargs": {}}}, "env_info.env_id", "this key", "no such key"),
        ({"seed": "7"}, "seed", "an integer, or a list of one integer", '"7"'),
        ({"layout": {"object_ids": ["a", 3]}}, "layout.object_ids.1", "text", "3"),
        ({"layout": {"poses": [POSE[:6]]}}, "layout.poses.0", "7 values", "6"),
        ({"layout": {"poses": [["x"] * 7] * 9}}, "layout.poses.0.0", "a number", '"x"'),
        ({"layout": {"object_ids": ["a"], "poses": []}}, "", "", ""),
        ({"layout": {"object_ids": ["a"], "poses": [POSE] * 2}}, "layout", None, None),
        ({"objects": [{"slot": -1, "id": "a", "name": "a"}]}, "objects.0.slot", "greater than or equal to 0", "-1"),
        ({"rate_hz": float("inf")}, "rate_hz", "a finite number", "Infinity"),
        ({"recorded": {"recoveries": [RECOVERY | {"range": [3]}]}}, "recorded.recoveries.0.range", "2 values", "1"),
    ],
)  # fmt: skip
def test_each_invalid_value_is_one_violation(new, key, expected, found):
    violations = check_values({**WHOLE, **new})
    assert [v.key for v in violations] == ([key] if key else [])
    assert expected is None or [said(v) for v in violations] == ([(key, expected, found)] if key else [])


def test_scene_that_is_not_an_object():
    assert read_valid_values(None) == ({}, "")
    assert read_valid_values([1]) == ({}, "scene.json: expected an object, found [1]")


@pytest.mark.parametrize(
    ("name", "new", "text"),
    [
        (FILE, {"seed": [99]}, f"{FILE}, seed: expected 5 (conversion.json), found 99"),
        (FILE, {"rate_hz": 10}, f"{FILE}, rate_hz: expected 5.0 (conversion.json), found 10"),
        (FILE, {"recorded": {"facts": {"x": float("nan")}}}, f"{FILE}: expected JSON, found"),
        ("conversion.json", {"rate_hz": None}, "conversion.json, rate_hz: expected a number, found null"),
        ("conversion.json", {"image_size": [64]}, "conversion.json, image_size: expected 2 values, found 1"),
        ("conversion.json", {"cameras": "base_camera"}, "conversion.json, cameras: expected a list"),
        ("conversion.json", {"cameras": []}, "conversion.json, cameras: expected 1 values, found 0"),
        ("conversion.json", {"episodes": []}, "conversion.json, episodes: expected an object, found []"),
        ("conversion.json", {"episodes": {"0": {}, "1": 3}}, "conversion.json, episodes.1: expected an object"),
        (FILE, "[1]", f"{FILE}: expected an object, found list"),
        ("conversion.json", "[]", "conversion.json: expected an object, found list"),
        ("conversion.json", '{"schema_version": 2', "conversion.json: expected JSON"),
    ],
)  # fmt: skip
def test_validate_reports_a_violation_once(dataset, name, new, text):
    if isinstance(new, str):
        (dataset / name).write_text(new)
    else:
        edit(dataset / name, lambda content: content.update(new))
    (violation,) = validate(dataset).violations
    assert str(violation).startswith(text)


def test_seed_in_a_list_is_accepted(dataset):
    edit(dataset / FILE, lambda content: content.update(seed=[5]))
    assert validate(dataset).violations == []
