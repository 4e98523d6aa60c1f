"""Check the language columns of a LeRobot dataset, those of ``lerobot-annotate`` too."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.lerobot.check_videos import TOLERANCE
from robocas_ms3.datasets.lerobot.language import EVENTS, PERSISTENT, Row, box_in, read_rows_of

_PERSISTENT_STYLES = {"subtask", "plan", "memory", "motion", "task_aug"}
_EVENT_STYLES = {"interjection", "vqa", "trace", None}
_OF_A_CAMERA = {"vqa", "trace"}


def check_language(table: pa.Table, file: str, number: int, info: Mapping[str, Any]) -> Iterator[Violation]:
    """Check the language rows of an episode.

    Args:
        table: frames of the episode.
        file: name of the file, for messages.
        number: of the episode.
        info: of the dataset.

    Raises:
        DatasetError: the columns hold no such rows.
    """
    persistent, events = (read_rows_of(table, key, file) for key in (PERSISTENT, EVENTS))
    if any(rows != persistent[0] for rows in persistent[1:]):
        yield Violation(file, f"episode {number}, {PERSISTENT}", "the same rows in each frame", "others")
        return
    for text, expected, found in _check_persistent(persistent[0] if persistent else [], len(table), info["fps"]):
        yield Violation(file, f"episode {number}, {PERSISTENT}{text}", expected, found)
    for step, rows in enumerate(events):
        for expected, found in _check_events(rows, info["features"]):
            yield Violation(file, f"episode {number}, {EVENTS}, frame {step}", expected, found)


def _check_persistent(rows: list[Row], count: int, fps: int) -> Iterator[tuple[str, str, str]]:
    for row in rows:
        if row["style"] not in _PERSISTENT_STYLES:
            yield ", style", ", ".join(sorted(_PERSISTENT_STYLES)), str(row["style"])
        step = row["timestamp"] * fps
        if abs(step - round(step)) > TOLERANCE * fps or not 0 <= round(step) < count:
            yield ", timestamp", f"that of a frame, 0 to {(count - 1) / fps:g} s", f"{row['timestamp']:g} s"
    starts = [row["timestamp"] for row in rows if row["style"] == "subtask"]
    if starts and min(starts) > TOLERANCE:
        yield ", subtask", "one from the first frame on", f"the first at {min(starts):g} s"
    if len(set(starts)) < len(starts):
        yield ", subtask", "one at a time", "several at once"


def _check_events(rows: list[Row], features: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for row in rows:
        style, camera = row["style"], row["camera"]
        if style not in _EVENT_STYLES:
            yield "style interjection, vqa, trace or none", str(style)
        elif style not in _OF_A_CAMERA:
            continue
        elif camera not in features or features[camera]["dtype"] not in ("video", "image"):
            yield "a camera of the dataset", str(camera)
        elif row["role"] == "assistant" and (box := box_in(row["content"])):
            height, width = features[camera]["shape"][:2]
            left, top, right, bottom = box
            if not (0 <= left <= right < width and 0 <= top <= bottom < height):
                yield f"a box in {width} x {height} pixels", str(list(box))
    pairs = Counter((row["style"], row["role"], row["camera"]) for row in rows if row["style"] == "vqa")
    if any(np.array(list(pairs.values())) > 1):
        yield "one question and answer per camera", "several"
