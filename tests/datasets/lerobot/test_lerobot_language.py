import json

import pytest

pa = pytest.importorskip("pyarrow", reason="needs the extra 'lerobot'")

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.lerobot.check_frames import check_language
from robocas_ms3.datasets.lerobot.language import (
    EVENTS,
    EVENTS_TYPE,
    PERSISTENT,
    PERSISTENT_TYPE,
    make_event_rows,
    make_paraphrases,
    make_persistent_rows,
    read_boxes,
    read_language_rows,
    read_subgoal_texts,
)
from robocas_ms3.demos.recordings.subgoals import SubGoal
from robocas_ms3.scenes.language.instructions import template_ids

GOALS = [SubGoal.from_range("move and grasp", "grasp it", 0, 2), SubGoal.from_range("transfer object", "drop it", 3, 6)]
CAMERA = "observation.images.base_camera"
INFO = {"fps": 5, "features": {CAMERA: {"dtype": "video", "shape": [48, 64, 3]}}}


def test_persistent_rows_worked_out_by_hand():
    rows = make_persistent_rows(GOALS, ["take it", "grab it", "take it"], fps=5)
    assert [(row["timestamp"], row["style"], row["role"], row["content"]) for row in rows] == [
        (0.0, "subtask", "assistant", "grasp it"),
        (0.0, "task_aug", "user", "take it"),
        (0.0, "task_aug", "user", "grab it"),
        (pytest.approx(0.6), "subtask", "assistant", "drop it"),
    ]
    assert rows[3]["timestamp"] == 0.6000000238418579  # float32, as the column timestamp
    assert {(row["camera"], row["tool_calls"]) for row in rows} == {(None, None)}


def test_event_rows_worked_out_by_hand():
    answer, question = make_event_rows({"base_camera": (3, 4, 10, 12)}, "sugar box")
    assert question == {
        "role": "user", "content": "Where is the sugar box?", "style": "vqa", "camera": CAMERA, "tool_calls": None
    }  # fmt: skip
    expected = {"detections": [{"bbox": [3, 4, 10, 12], "bbox_format": "xyxy", "label": "sugar box"}]}
    assert json.loads(answer["content"]) == expected
    assert (answer["role"], answer["style"], answer["camera"]) == ("assistant", "vqa", CAMERA)
    assert make_event_rows({"base_camera": (0, 0, 1, 1)}, "scissors")[1]["content"] == "Where are the scissors?"
    assert make_event_rows({}, "sugar box") == []
    several = make_event_rows({"static_camera": (1, 1, 2, 2), "base_camera": (0, 0, 1, 1)}, "pear")
    assert [row["role"] for row in several] == ["assistant"] * 2 + ["user"] * 2
    cameras = [row["camera"].removeprefix("observation.images.") for row in several]
    assert cameras == ["base_camera", "static_camera"] * 2


@pytest.mark.parametrize("fps", [1, 3, 7, 100])
def test_goals_of_frames(fps):
    rows = make_persistent_rows(GOALS, [], fps)
    assert read_subgoal_texts(rows, 7, fps) == ["grasp it"] * 3 + ["drop it"] * 4
    assert read_subgoal_texts(rows[1:], 7, fps) == [""] * 3 + ["drop it"] * 4
    assert read_subgoal_texts([], 2, fps) == ["", ""]


@pytest.mark.parametrize(
    "answer",
    [
        None,
        "",
        "[]",
        '{"detections": []}',
        '{"detections": [{"bbox": [1, 2, 3, 4]}, {"bbox": [1, 2, 3, 4]}]}',
        *(f'{{"detections": [{{"bbox": {box}}}]}}' for box in ("[1, 2, 3]", '"1234"')),
        *(f'{{"detections": [{{"bbox": [1, 2, {n}, 4]}}]}}' for n in ('"3"', "3.5", "true", "1e400")),
    ],
)
def test_answers_without_exactly_one_integer_box_are_ignored(answer):
    rows = make_event_rows({"base_camera": (1, 2, 3, 4)}, "pear")
    assert read_boxes(rows) == {"base_camera": (1, 2, 3, 4)}
    assert read_boxes([{**rows[0], "content": answer}, rows[1]]) == {}


SCENE = {
    "task": "pick",
    "target": {"slot": 0, "asset_id": "pear", "name": "pear"},
    "recorded": {"support": "table", "relation": ""},
}


def test_paraphrases_use_training_templates():
    texts = make_paraphrases(SCENE, "grasp the pear on the table and move it to the basket")
    assert texts[0] == "grasp the pear on the table and move it to the basket"
    assert "put the pear into the basket" in texts
    assert len(texts) == 1 + len(template_ids("pick", "train"))
    assert "fetch the pear from the table and deposit it in the basket" not in texts  # held out


def test_paraphrases_with_a_relation_and_a_part():
    related = {**SCENE, "task": "select", "recorded": {"support": "table", "relation": "nearest"}}
    assert all("nearest pear" in text or "closest" in text for text in make_paraphrases(related, "")[1:])
    opened = {**SCENE, "task": "open_pick", "config": {"opening": {"handle": "door_left"}}}
    assert any("left door" in text for text in make_paraphrases(opened, ""))


@pytest.mark.parametrize(
    "scene",
    [
        {},
        {**SCENE, "task": "dance"},
        {**SCENE, "target": None},
        {**SCENE, "recorded": None},
        {**SCENE, "task": "open_pick"},
    ],
)
def test_no_paraphrases_of_unknown_scenes(scene):
    assert make_paraphrases(scene, "do it") == []


def table_of(persistent, events):
    return pa.table(
        {PERSISTENT: pa.array([persistent] * len(events), PERSISTENT_TYPE), EVENTS: pa.array(events, EVENTS_TYPE)}
    )


def found(persistent, events):
    return [f"{key}: {expected}" for key, expected, _ in check_language(table_of(persistent, events), "file", INFO)]


ROWS = make_persistent_rows(GOALS, ["take it"], 5)
EVENT = make_event_rows({"base_camera": (3, 4, 63, 47)}, "pear")


def test_valid_rows():
    assert found(ROWS, [EVENT, *[[]] * 6]) == []
    speech = {"role": "assistant", "content": None, "style": None, "camera": None, "tool_calls": ["say"]}
    assert found(ROWS, [[speech], *[[]] * 6]) == []


@pytest.mark.parametrize(
    ("persistent", "events", "message"),
    [
        ([{**ROWS[0], "style": "dance"}], [[]], "style: "),
        ([*ROWS[:2], {**ROWS[2], "timestamp": 0.7}], [[]] * 7, "timestamp: "),
        (ROWS, [[]] * 3, "timestamp: "),
        ([ROWS[2]], [[]] * 7, "subtask: a subtask at the first"),
        ([ROWS[0], ROWS[0]], [[]], "subtask: one subtask at a time"),
        (ROWS, [[{**EVENT[0], "camera": None}], *[[]] * 6], "a camera of the dataset"),
        (ROWS, [[{**EVENT[0], "style": "subtask"}], *[[]] * 6], "style interjection"),
        (ROWS, [[*EVENT, *EVENT], *[[]] * 6], "one question"),
        (ROWS, [make_event_rows({"base_camera": (3, 4, 64, 5)}, "pear"), *[[]] * 6], "a box"),
        (ROWS, [make_event_rows({"base_camera": (9, 4, 8, 5)}, "pear"), *[[]] * 6], "a box"),
    ],
)
def test_rows_that_are_wrong(persistent, events, message):
    texts = found(persistent, events)
    assert any(message in text for text in texts), texts


def test_different_rows_in_frames_are_reported():
    table = pa.table({PERSISTENT: pa.array([ROWS, ROWS[:1]], PERSISTENT_TYPE), EVENTS: pa.array([[], []], EVENTS_TYPE)})
    assert "the same rows in each frame" in str(next(check_language(table, "file", INFO)))


@pytest.mark.parametrize(
    "column",
    [[1, 2], ["a", "b"], [["a"], []], [[{"role": "user"}], []], [[{**ROWS[0], "timestamp": float("nan")}], []]],
)
def test_columns_without_language_rows_are_refused(column):
    with pytest.raises(DatasetError):
        read_language_rows(pa.table({PERSISTENT: pa.array(column)}), PERSISTENT, "file")


def test_columns_as_arrow_infers_them():
    """``lerobot-annotate`` writes no types: times become float64, and a field of nulls has the type null."""
    table = pa.table({PERSISTENT: pa.array([ROWS, ROWS]), EVENTS: pa.array([[], []])})
    assert read_language_rows(table, PERSISTENT, "file")[0] == ROWS
    assert read_language_rows(table, EVENTS, "file") == [[], []]
    with pytest.raises(DatasetError):
        read_language_rows(table.drop([EVENTS]), EVENTS, "file")
