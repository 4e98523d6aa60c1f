"""``conversion.json``: the settings of a dataset, and the recording of each episode.

The file is written before the first episode, so that an interrupted conversion continues with the same numbers.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError, OutputExistsError
from robocas_ms3.core.output_folder import FolderKind, OutputFolder
from robocas_ms3.core.strict_model import parse
from robocas_ms3.core.text import format_ranges
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.sources.file_models import ConversionRecord, SettingsRecord
from robocas_ms3.datasets.sources.split import SPLIT_RULE, split_by_seed
from robocas_ms3.demos.recordings.trajectory_json import package_versions

Entries = Sequence[dict[str, Any]]
"""See `conversion_input.ConversionInput.entries`."""
SETTINGS_KEYS = tuple(SettingsRecord.model_fields)
"""Keys of the settings."""
SKIPPED_KEY = "skipped"
"""Key of the episodes that could not be written, each with a ``reason``; a continued conversion tries them again."""
MARKER_FILES = (schema.CONVERSION_FILE, schema.DATA_INFO_FILE)
"""Files that mark a folder as a RoboCAS dataset, complete or not."""


def add_versions(record: dict[str, Any]) -> dict[str, Any]:
    """Set ``made_with`` to the current package versions if it is incomplete, as in merged datasets."""
    now, made_with = package_versions(), record.get("made_with")
    is_complete = isinstance(made_with, dict) and now.keys() <= made_with.keys()
    return record if is_complete else {**record, "made_with": now}


DATASET = FolderKind(
    "robocas convert", (schema.CONVERSION_FILE,), "rate_hz", markers=MARKER_FILES, upgrade=add_versions
)


def make_settings(rate_hz: float, image_options: ImageOptions, embeddings: bool) -> dict[str, Any]:
    """Make the settings of a dataset for ``conversion.json``."""
    settings = SettingsRecord(
        rate_hz=float(rate_hz),
        cameras=list(image_options.cameras),
        image_size=list(image_options.size) if image_options.size else None,
        image_format=image_options.image_format,
        depth=image_options.depth,
        embeddings=embeddings,
    )
    return settings.model_dump()


def make_header(settings: Mapping[str, Any], split_rule: str = SPLIT_RULE) -> dict[str, Any]:
    """Make the content of ``conversion.json`` without the episodes."""
    version = {"format": "robocas", "schema_version": schema.SCHEMA_VERSION, "made_with": package_versions()}
    return {**version, **settings, "split": split_rule}


def plan_episodes(
    output: OutputFolder, entries: Entries, settings: dict[str, Any], *, append: bool
) -> tuple[dict[str, Any], list[tuple[int, int]]]:
    """Assign a number in the dataset to each episode of a source.

    Recordings that are in the dataset already keep their number. ``append`` allows new recordings; they are numbered
    after the existing episodes. Return the new content of ``conversion.json``, and (number in the dataset, number in
    the source) of each episode, written or not.
    """
    path, content = output.path / schema.CONVERSION_FILE, output.recorded
    if content is None:
        if append:
            raise DatasetError("no dataset to append to", where=path, fix="Convert without --append first.")
        content = make_header(settings)
    else:
        schema.check_version(content.get("schema_version", 1), path)
        parse(ConversionRecord, content, DatasetError, where=path)
    episodes, skipped = dict(content.get("episodes", {})), dict(content.get(SKIPPED_KEY, {}))
    planned = {entry["recording"]: number for number, entry in episodes.items() if entry.get("recording")}
    unread = {number: entry for number, entry in episodes.items() if not entry.get("recording")}
    again = {_recording_key(entry): number for number, entry in {**unread, **skipped}.items()}
    first_new = max(map(int, [*episodes, *skipped]), default=-1) + 1
    tasks, new = [], 0
    for entry in entries:
        number = planned.get(entry["recording"]) or again.get(_recording_key(entry))
        if number is None:
            number, new = str(first_new + new), new + 1
        if number not in episodes or number in unread:
            skipped.pop(number, None)
            episodes[number] = {key: value for key, value in entry.items() if key != "source"}
        tasks.append((int(number), entry["source"]))
    if new and output.recorded is not None and not append:
        found, fix = (
            f"{new} of {len(entries)} recordings are new",
            "Pass --append to add them, or --overwrite to start again.",
        )
        raise OutputExistsError("this dataset has other recordings", where=path, found=found, fix=fix)
    return json.loads(json.dumps(_replace_episodes(content, episodes, skipped))), tasks


def move_unwritten_to_skipped(out: Path, content: Mapping[str, Any], reasons: Mapping[str, str]) -> dict[str, Any]:
    """Move the entries of unwritten episodes to ``skipped``.

    Return the new content of ``conversion.json``. ``reasons``: why episodes could not be written, by the name of the
    episode folder.
    """
    episodes, skipped = dict(content["episodes"]), dict(content.get(SKIPPED_KEY, {}))
    for folder, reason in reasons.items():
        if not (out / folder).is_dir():
            number = str(schema.episode_number(folder))
            skipped[number] = {**episodes.pop(number), "reason": reason}
    return _replace_episodes(content, episodes, skipped)


def _replace_episodes(
    content: Mapping[str, Any], episodes: Mapping[str, Any], skipped: Mapping[str, Any]
) -> dict[str, Any]:
    lists = {"episodes": episodes, **({SKIPPED_KEY: skipped} if skipped else {})}
    in_order = {key: {number: entries[number] for number in sorted(entries, key=int)} for key, entries in lists.items()}
    return {key: value for key, value in content.items() if key not in ("episodes", SKIPPED_KEY)} | in_order


def _recording_key(entry: Mapping[str, Any]) -> str:
    """Return a key that identifies a recording without a fingerprint."""
    return json.dumps([entry.get(key) for key in ("trajectory", "trajectory_episode", "seed")])


def split_planned_episodes(
    content: Mapping[str, Any], previous: tuple[list[int], list[int]]
) -> tuple[list[int], list[int]]:
    """Split all episodes of ``conversion.json``, written or not; return training and validation."""
    return split_by_seed({int(number): entry.get("seed") for number, entry in content["episodes"].items()}, previous)


def describe_missing_episodes(out: Path, content: Mapping[str, Any]) -> list[str]:
    """Describe the missing episodes, one text per trajectory file: ``episodes 4-6 of select.h5``."""
    missing: dict[str, list[int]] = {}
    for number, entry in content["episodes"].items():
        if not (out / schema.episode_folder(int(number))).is_dir():
            missing.setdefault(str(entry.get("trajectory") or "?"), []).append(int(number))
    return [f"episodes {format_ranges(numbers)} of {name}" for name, numbers in missing.items()]
