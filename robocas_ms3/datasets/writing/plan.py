"""``conversion.json``: a dataset's settings, and which recording becomes which episode.

It is written before the first episode, so that a conversion killed at any moment can go on with the same numbers.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError, OutputExistsError
from robocas_ms3.core.outputs import OutputFolder
from robocas_ms3.core.strict import parse
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.records import ConversionRecord, SettingsRecord
from robocas_ms3.datasets.sources.split import SPLIT_RULE, split_by_seed
from robocas_ms3.demos.recordings.entries import one_seed, versions

Entries = Sequence[dict[str, Any]]
"""What is to be converted, see `players.Player.entries`."""

SETTINGS = tuple(SettingsRecord.model_fields)
"""Keys of the settings."""

LEFT_OUT = "left_out"
"""Key of the episodes that could not be written, each with ``why``; a conversion that goes on tries them again."""


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
    """Return the settings of ``conversion.json``."""
    settings = SettingsRecord(
        rate_hz=float(rate_hz),
        cameras=list(pictures.cameras),
        image_size=list(pictures.size) if pictures.size else None,
        image_format=pictures.image_format,
        depth=pictures.depth,
        embeddings=embeddings,
    )
    return settings.model_dump()


def plan_episodes(output: OutputFolder, entries: Entries, settings: dict[str, Any], *, append: bool) -> Plan:
    """Number a source's episodes: from 0, or as recorded, new ones after the episodes of the dataset.

    Args:
        output: folder of the dataset.
        entries: recordings to convert.
        settings: of the dataset.
        append: whether recordings may be new to a dataset that exists.

    Raises:
        OutputExistsError: some are new to the dataset that is continued.
        DatasetError: there is no dataset to append to, or its ``conversion.json`` is damaged.
    """
    path, recorded = output.path / schema.CONVERSION_FILE, output.recorded
    if recorded is None:
        if append:
            raise DatasetError("no dataset to append to", where=path, fix="Convert without --append first.")
        return _extended(header(settings), {}, entries, first=0)
    schema.check_version(recorded.get("schema_version", 1), path)
    parse(ConversionRecord, recorded, DatasetError, where=path)
    content, known, new = _divided({**recorded, "episodes": recorded.get("episodes", {})}, entries)
    if new and not append:
        found, fix = f"{len(new)} of {len(entries)} are new", "Pass --append to add them, --overwrite to start again."
        raise OutputExistsError("a dataset of other recordings", where=path, found=found, fix=fix)
    first = max(map(int, [*content["episodes"], *content.get(LEFT_OUT, {})]), default=-1) + 1
    plan = _extended(content, content["episodes"], new, first)
    return Plan(plan.content, [*known, *plan.tasks])


def _divided(
    before: Mapping[str, Any], entries: Entries
) -> tuple[dict[str, Any], list[tuple[int, int]], list[dict[str, Any]]]:
    """Content of ``conversion.json`` as it goes on, where what was left out and comes again is an episode again.

    Also gives (number, number in the source) of the episodes that are planned already, and the entries that are not.
    """
    episodes, left_out = dict(before["episodes"]), dict(before.get(LEFT_OUT, {}))
    planned = {entry["recording"]: number for number, entry in episodes.items() if entry.get("recording")}
    unread = {number: entry for number, entry in episodes.items() if not entry.get("recording")}
    again = {_place(entry): number for number, entry in {**unread, **left_out}.items()}
    known, new = [], []
    for entry in entries:
        number = planned.get(entry["recording"]) or again.get(_place(entry))
        if number is None:
            new.append(entry)
            continue
        known.append((int(number), entry["source"]))
        if number in unread or left_out.pop(number, None):
            episodes[number] = _without_source(entry)
    in_order = {number: episodes[number] for number in sorted(episodes, key=int)}
    content = {key: value for key, value in before.items() if key != LEFT_OUT} | {"episodes": in_order}
    return {**content, **({LEFT_OUT: left_out} if left_out else {})}, known, new


def _place(entry: Mapping[str, Any]) -> str:
    """What tells recordings apart that may not have been readable."""
    return json.dumps([entry.get(key) for key in ("trajectory", "trajectory_episode", "seed")])


def without_unwritten(out: Path, plan: Plan, reasons: Mapping[str, str]) -> dict[str, Any]:
    """Content of ``conversion.json`` where episodes of a plan could not be written.

    Args:
        out: the dataset.
        plan: it.
        reasons: why, by name of the episode's folder.
    """
    episodes = dict(plan.content["episodes"])
    left_out = dict(plan.content.get(LEFT_OUT, {}))
    for number, _ in plan.tasks:
        folder = schema.episode_folder(number)
        if not (out / folder).is_dir():
            left_out[str(number)] = {**episodes.pop(str(number)), "why": reasons[folder]}
    in_order = {number: left_out[number] for number in sorted(left_out, key=int)}
    return {**plan.content, "episodes": episodes, LEFT_OUT: in_order}


def planned_sides(content: Mapping[str, Any], before: tuple[list[int], list[int]]) -> tuple[list[int], list[int]]:
    """Training and validation episodes of all that are planned, so that those not there yet change no other's side.

    Args:
        content: of ``conversion.json``.
        before: the sides so far.
    """
    seeds = {int(number): one_seed(entry.get("seed")) for number, entry in content["episodes"].items()}
    return split_by_seed({number: number if seed is None else seed for number, seed in seeds.items()}, before)


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


def header(settings: Mapping[str, Any], split_rule: str = SPLIT_RULE) -> dict[str, Any]:
    """What ``conversion.json`` says of a dataset as a whole."""
    return {
        "format": "robocas",
        "schema_version": schema.SCHEMA_VERSION,
        "made_with": versions(),
        **settings,
        "split": split_rule,
    }


def _extended(head: Mapping[str, Any], episodes: Mapping[str, Any], entries: Entries, first: int) -> Plan:
    tasks = [(number, entry["source"]) for number, entry in enumerate(entries, start=first)]
    added = {str(number): _without_source(entry) for number, entry in enumerate(entries, start=first)}
    return Plan(json.loads(json.dumps({**head, "episodes": {**episodes, **added}})), tasks)


def _without_source(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key != "source"}
