"""``conversion.json``: the settings of a dataset, and which recording becomes which episode.

It is written before the first episode, so that a conversion that was killed continues with the same numbers.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError, OutputExistsError
from robocas_ms3.core.outputs import FolderKind, OutputFolder
from robocas_ms3.core.strict import parse
from robocas_ms3.core.words import format_ranges
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.records import ConversionRecord, SettingsRecord
from robocas_ms3.datasets.sources.split import SPLIT_RULE, split_by_seed
from robocas_ms3.demos.recordings.entries import one_seed, versions

Entries = Sequence[dict[str, Any]]
"""See `inputs.ConversionInput.entries`."""
SETTINGS = tuple(SettingsRecord.model_fields)
"""Keys of the settings."""
LEFT_OUT = "left_out"
"""Key of the episodes that could not be written, each with ``why``; a continued conversion tries them again."""
MARKS = (schema.CONVERSION_FILE, schema.DATA_INFO_FILE)
"""A folder with one of these is a RoboCAS dataset, whole or not."""


def with_versions(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record with the versions of today if it does not name them all, as that of merged datasets."""
    now, made_with = versions(), record.get("made_with")
    is_whole = isinstance(made_with, dict) and now.keys() <= made_with.keys()
    return record if is_whole else {**record, "made_with": now}


DATASET = FolderKind("robocas convert", (schema.CONVERSION_FILE,), "rate_hz", marks=MARKS, upgrade=with_versions)


@dataclass(frozen=True)
class EpisodePlan:
    """The episodes that a dataset will have.

    Attributes:
        content: of ``conversion.json``.
        tasks: (number in the dataset, number in the source) of each episode of this source, written or not.
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


def header(settings: Mapping[str, Any], split_rule: str = SPLIT_RULE) -> dict[str, Any]:
    """Return ``conversion.json`` without the episodes."""
    version = {"format": "robocas", "schema_version": schema.SCHEMA_VERSION, "made_with": versions()}
    return {**version, **settings, "split": split_rule}


def plan_episodes(output: OutputFolder, entries: Entries, settings: dict[str, Any], *, append: bool) -> EpisodePlan:
    """Number the episodes of a source: as recorded, new ones after those of the dataset.

    Args:
        output: folder of the dataset.
        entries: recordings to convert.
        settings: of the dataset.
        append: whether recordings may be new to a dataset that exists.
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
    return EpisodePlan(plan.content, [*known, *plan.tasks])


def _divided(
    before: Mapping[str, Any], entries: Entries
) -> tuple[dict[str, Any], list[tuple[int, int]], list[dict[str, Any]]]:
    """Return ``conversion.json``, tasks of planned episodes, and new entries; episodes left out are planned again."""
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


def _extended(head: Mapping[str, Any], episodes: Mapping[str, Any], entries: Entries, first: int) -> EpisodePlan:
    tasks = [(number, entry["source"]) for number, entry in enumerate(entries, start=first)]
    added = {str(number): _without_source(entry) for number, entry in enumerate(entries, start=first)}
    return EpisodePlan(json.loads(json.dumps({**head, "episodes": {**episodes, **added}})), tasks)


def _without_source(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key != "source"}


def _place(entry: Mapping[str, Any]) -> str:
    """Return what distinguishes recordings that may have been unreadable."""
    return json.dumps([entry.get(key) for key in ("trajectory", "trajectory_episode", "seed")])


def without_unwritten(out: Path, plan: EpisodePlan, reasons: Mapping[str, str]) -> dict[str, Any]:
    """Return ``conversion.json`` without the episodes that could not be written; reasons by name of their folder."""
    episodes, left_out = dict(plan.content["episodes"]), dict(plan.content.get(LEFT_OUT, {}))
    for number, _ in plan.tasks:
        folder = schema.episode_folder(number)
        if not (out / folder).is_dir():
            left_out[str(number)] = {**episodes.pop(str(number)), "why": reasons[folder]}
    in_order = {number: left_out[number] for number in sorted(left_out, key=int)}
    return {**plan.content, "episodes": episodes, LEFT_OUT: in_order}


def planned_sides(content: Mapping[str, Any], before: tuple[list[int], list[int]]) -> tuple[list[int], list[int]]:
    """Return the split of all planned episodes, so that missing ones change the side of no other.

    Args:
        content: of ``conversion.json``.
        before: the sides so far.
    """
    seeds = {int(number): one_seed(entry.get("seed")) for number, entry in content["episodes"].items()}
    return split_by_seed({number: number if seed is None else seed for number, seed in seeds.items()}, before)


def missing_episodes(out: Path, content: Mapping[str, Any]) -> list[str]:
    """Return which planned episodes are not there, one text per trajectory: ``episodes 4-6 of select.h5``."""
    missing: dict[str, list[int]] = {}
    for number, entry in content["episodes"].items():
        if not (out / schema.episode_folder(int(number))).is_dir():
            missing.setdefault(str(entry.get("trajectory") or "?"), []).append(int(number))
    return [f"episodes {format_ranges(numbers)} of {name}" for name, numbers in missing.items()]
