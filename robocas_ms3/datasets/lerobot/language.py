"""Rows of the language columns of LeRobot 0.6 and later: sub-goals, paraphrases and bounding boxes.

==========  ====================  =========  ===================================================  =========
style       column                role       content                                              timestamp
==========  ====================  =========  ===================================================  =========
task_aug    language_persistent   user       instruction or paraphrase                            0
subtask     language_persistent   assistant  text of the sub-goal that starts at this time        its start
vqa         language_events       user       question about the target, per camera                the frame
vqa         language_events       assistant  JSON: bounding box of the visible target             the frame
==========  ====================  =========  ===================================================  =========

The persistent rows of an episode are the same in each of its frames. A sub-goal lasts until the next one starts.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from pydantic import BaseModel, ValidationError

from robocas_ms3.core.errors import DatasetError, RobocasError
from robocas_ms3.core.strict_model import validate_json
from robocas_ms3.core.text import one_line
from robocas_ms3.datasets.checks.scene import read_valid_values
from robocas_ms3.datasets.images.image_files import Box
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.demos.recordings.subgoals import SubGoal
from robocas_ms3.scenes.language.instructions import (
    InstructionSlots,
    is_plural,
    make_instruction,
    part_name,
    template_ids,
)

PERSISTENT, EVENTS = "language_persistent", "language_events"
Row = dict[str, Any]

_TOOL_CALLS = pa.field("tool_calls", pa.list_(pa.string()))
_TEXTS = [
    pa.field("role", pa.string(), nullable=False),
    pa.field("content", pa.string()),
    pa.field("style", pa.string()),
]
_CAMERA = pa.field("camera", pa.string())
PERSISTENT_TYPE = pa.list_(
    pa.struct([*_TEXTS, pa.field("timestamp", pa.float32(), nullable=False), _CAMERA, _TOOL_CALLS])
)
EVENTS_TYPE = pa.list_(pa.struct([*_TEXTS, _CAMERA, _TOOL_CALLS]))
"""Arrow types of the columns, as in LeRobot."""


def make_persistent_rows(goals: Sequence[SubGoal], instructions: Iterable[str], fps: int) -> list[Row]:
    """Make the ``language_persistent`` rows of an episode, sorted as in LeRobot.

    Repeated instructions are dropped.
    """
    rows = [_make_row("user", text, "task_aug", timestamp=0.0) for text in dict.fromkeys(instructions)]
    starts = [(goal, float(np.float32(goal.first / fps))) for goal in goals]
    rows += [_make_row("assistant", goal.goal_description, "subtask", timestamp=start) for goal, start in starts]
    return sorted(rows, key=lambda row: (row["timestamp"], row["style"]))


def make_event_rows(boxes: Mapping[str, Box], target: str) -> list[Row]:
    """Make the ``language_events`` rows of a frame: question and answer per camera that sees the target."""
    question = f"Where {'are' if is_plural(target) else 'is'} the {target}?"
    rows = []
    for camera, box in boxes.items():
        detection = {"label": target, "bbox_format": "xyxy", "bbox": list(box)}
        answer = json.dumps({"detections": [detection]}, sort_keys=True, ensure_ascii=False)
        rows += make_vqa_rows(question, answer, schema.image_key(camera))
    return sorted(rows, key=lambda row: (row["role"], row["camera"]))


def make_vqa_rows(question: str, answer: str, image_key: str) -> list[Row]:
    """Make the ``language_events`` rows of a question about the image with a key, and of its answer."""
    return [
        _make_row("user", question, "vqa", camera=image_key),
        _make_row("assistant", answer, "vqa", camera=image_key),
    ]


def _make_row(role: str, content: str, style: str, *, timestamp: float | None = None, camera: str | None = None) -> Row:
    row: Row = {"role": role, "content": content, "style": style}
    if timestamp is not None:
        row["timestamp"] = timestamp
    return {**row, "camera": camera, "tool_calls": None}


def make_paraphrases(scene: Mapping[str, Any], text: str) -> list[str]:
    """Return the instruction and its paraphrases, one per instruction template of the split ``train``.

    Paraphrases name objects without synonyms. Templates of the split ``held_out`` are for evaluation and are never
    used. The list is empty if ``scene.json`` lacks the task, target or support of the instruction.
    """
    known, _ = read_valid_values(scene)
    task, target, recorded = known.get("task"), known.get("target") or {}, known.get("recorded") or {}
    if not (task and target.get("name") and recorded.get("support")):
        return []
    opening = (known.get("config") or {}).get("opening") or {}
    try:
        part = opening.get("part") or (part_name(opening["handle"]) if opening.get("handle") else "")
        slots = InstructionSlots(
            task, target["name"], recorded["support"], relation=recorded.get("relation") or None, part=part
        )
        texts = [make_instruction(slots, template).text for template in template_ids(task, "train")]
    except (
        RobocasError,
        LookupError,
        AttributeError,
        TypeError,
    ):  # a task, relation or configuration of another version
        return []
    return list(dict.fromkeys([text, *texts])) if texts else []


def read_subgoal_texts(rows: Sequence[Row], count: int, fps: int) -> list[str]:
    """Read the sub-goal text of each frame from ``language_persistent`` rows.

    The text is empty before the first sub-goal.
    """
    starts = sorted((row["timestamp"], row["content"] or "") for row in rows if row["style"] == "subtask")
    times = (np.arange(count) + 0.5) / fps
    places = np.searchsorted([time for time, _ in starts], times, side="right") - 1
    return [starts[place][1] if place >= 0 else "" for place in places.tolist()]


def read_boxes(rows: Sequence[Row]) -> dict[str, Box]:
    """Read the bounding box of the target, by camera, from the ``language_events`` rows of a frame."""
    boxes = {}
    for row in rows:
        if (
            row["style"] == "vqa"
            and row["role"] == "assistant"
            and row["camera"]
            and (box := parse_box(row["content"]))
        ):
            boxes[schema.camera_name(row["camera"])] = box
    return boxes


class _Detection(BaseModel):
    bbox: Box


class _Answer(BaseModel):
    detections: tuple[_Detection]


def parse_box(answer: str | None) -> Box | None:
    """Parse the bounding box in the answer of a ``vqa`` row.

    The result is None if the answer is not the JSON of one detection.
    """
    try:
        (detection,) = validate_json(_Answer, answer or "").detections
    except ValidationError:
        return None
    return detection.bbox


def read_language_rows(table: pa.Table, key: str, where: object) -> list[list[Row]]:
    """Read a language column, a list of rows per frame; raise DatasetError if the column is damaged."""
    kind = PERSISTENT_TYPE if key == PERSISTENT else EVENTS_TYPE
    try:
        frames = table.column(key).cast(kind).to_pylist()
    except (LookupError, ValueError, pa.ArrowException) as error:
        what = "invalid language column"
        raise DatasetError(what, where=f"{where}, {key}", expected=str(kind), found=one_line(error)) from error
    found = [frame or [] for frame in frames]
    if not all(row is not None and np.isfinite(row.get("timestamp", 0)) for rows in found for row in rows):
        raise DatasetError("damaged language row", where=f"{where}, {key}", expected="a finite timestamp")
    return found
