"""``conversion.json``: a dataset's settings, and which recording becomes which episode.

It is written before the first episode, so that a conversion killed at any moment can go on with the same numbers.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import robocas_ms3
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.split import SPLIT_RULE
from robocas_ms3.documents import load_json
from robocas_ms3.errors import DatasetError
from robocas_ms3.outputs import check_same, is_taken

Entries = Sequence[dict[str, Any]]
"""What is to be converted, see `players.Player.entries`."""

SETTINGS = ("rate_hz", "cameras", "image_size", "image_format", "depth", "embeddings")
"""What all episodes of a dataset share."""


@dataclass(frozen=True)
class Plan:
    """What a dataset will be.

    Attributes:
        content: of ``conversion.json``.
        tasks: (episode number, number in the source) of all of this source's episodes in it, written or not.
    """

    content: dict[str, Any]
    tasks: list[tuple[int, int]]


def dataset_settings(rate_hz: float, pictures: Pictures, embeddings: bool) -> dict[str, Any]:
    """The settings part of ``conversion.json``."""
    return {
        "rate_hz": float(rate_hz),
        "cameras": list(pictures.cameras),
        "image_size": list(pictures.size) if pictures.size else None,
        "image_format": pictures.image_format,
        "depth": pictures.depth,
        "embeddings": embeddings,
    }


def new_plan(entries: Entries, settings: dict[str, Any]) -> Plan:
    """Number a source's episodes from 0 on."""
    return _extended(header(settings), {}, entries, first=0)


def resumed_plan(out: Path, entries: Entries, settings: dict[str, Any]) -> Plan:
    """Go on with what was begun; where nothing was, begin.

    Raises:
        DatasetError: another conversion was begun there.
    """
    if not is_taken(out):
        return new_plan(entries, settings)
    before = _read(out, missing="can't resume: no conversion was begun here", fix="Pass --overwrite.")
    _check_settings(out, before, settings, "resume", "Pass --overwrite, or the settings of before.")
    known, new = _divided(before, entries)
    if new:
        raise DatasetError(
            "can't resume: these recordings are not what was begun here",
            where=out / schema.CONVERSION_FILE,
            found=f"{len(new)} of {len(entries)} are new",
            fix="Pass --append to add them, --overwrite to begin again.",
        )
    return Plan(before, known)


def appended_plan(out: Path, entries: Entries, settings: dict[str, Any]) -> Plan:
    """Number what is new after what is there; what is there already keeps its number.

    Raises:
        DatasetError: there is no dataset of ours, or of other settings.
    """
    before = _read(out, missing="no dataset to append to", fix="Convert without --append first.")
    _check_settings(out, before, settings, "append", "Pass the settings of before.")
    known, new = _divided(before, entries)
    first = max((int(number) for number in before["episodes"]), default=-1) + 1
    plan = _extended(before, before["episodes"], new, first)
    return Plan(plan.content, [*known, *plan.tasks])


def _divided(before: Mapping[str, Any], entries: Entries) -> tuple[list[tuple[int, int]], list[dict[str, Any]]]:
    """(Number, number in the source) of the episodes that are planned already, and the entries that are not."""
    planned = {entry["recording"]: int(number) for number, entry in before["episodes"].items()}
    known = [(planned[entry["recording"]], entry["source"]) for entry in entries if entry["recording"] in planned]
    return known, [entry for entry in entries if entry["recording"] not in planned]


def still_missing(out: Path, content: Mapping[str, Any]) -> list[str]:
    """Which planned episodes are not there: ``episodes 4-6 of select.h5``, one text a trajectory."""
    missing: dict[str, list[int]] = {}
    for number, entry in content["episodes"].items():
        if not (out / schema.episode_folder(int(number))).is_dir():
            missing.setdefault(str(entry.get("trajectory") or "?"), []).append(int(number))
    return [f"episodes {_spans(numbers)} of {name}" for name, numbers in missing.items()]


def _spans(numbers: list[int]) -> str:
    """``0, 4-6``."""
    spans: list[list[int]] = []
    for number in sorted(numbers):
        if spans and number == spans[-1][1] + 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    return ", ".join(f"{first}-{last}" if first < last else str(first) for first, last in spans)


def _check_settings(out: Path, before: Mapping[str, Any], settings: Mapping[str, Any], verb: str, fix: str) -> None:
    now = {key: settings[key] for key in SETTINGS}
    what, where = f"can't {verb} with other settings", out / schema.CONVERSION_FILE
    check_same(before, now, what, where=where, fix=fix, error=DatasetError)


def header(settings: Mapping[str, Any], split_rule: str = SPLIT_RULE) -> dict[str, Any]:
    """What ``conversion.json`` says of a dataset as a whole."""
    return {
        "format": "robocas",
        "schema_version": schema.SCHEMA_VERSION,
        "made_with": {"robocas_ms3": robocas_ms3.__version__},
        **settings,
        "split": split_rule,
    }


def _extended(head: Mapping[str, Any], episodes: Mapping[str, Any], entries: Entries, first: int) -> Plan:
    tasks = [(number, entry["source"]) for number, entry in enumerate(entries, start=first)]
    added = {
        str(number): {key: value for key, value in entry.items() if key != "source"}
        for number, entry in enumerate(entries, start=first)
    }
    return Plan(json.loads(json.dumps({**head, "episodes": {**episodes, **added}})), tasks)


def _read(out: Path, missing: str, fix: str) -> dict[str, Any]:
    path = out / schema.CONVERSION_FILE
    try:
        content = load_json(path)
    except (OSError, ValueError) as error:
        raise DatasetError(missing, where=path, fix=fix) from error
    schema.check_version(content.get("schema_version", 1), path)
    return content
