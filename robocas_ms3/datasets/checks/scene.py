"""Checks of ``conversion.json``, of the ``scene.json`` of each episode, and for duplicate episodes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import one_line
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.violation import Violation, check_form, read_object, shorten
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.sources.arrays import EpisodeArrays, arrays_fingerprint
from robocas_ms3.datasets.sources.file_models import ConversionRecord, SceneRecord, fill_unknown_keys
from robocas_ms3.demos.recordings.trajectory_json import parse_seed
from robocas_ms3.robots.cameras import STANDARD_CAMERA_NAMES

FILE = schema.CONVERSION_FILE
STANDARD = ImageOptions(STANDARD_CAMERA_NAMES)


def valid_values(scene: Any, file: str = schema.SCENE_FILE) -> tuple[dict[str, Any], str]:
    """Return the valid entries of a ``scene.json`` and a text on the invalid ones; keys may be missing."""
    if not isinstance(scene, Mapping):
        return {}, "" if scene is None else f"{file}: expected an object, found {shorten(scene)}"
    wrong = check_form(SceneRecord, fill_unknown_keys(scene), file)
    return _usable(scene, wrong), "; ".join(map(str, wrong))


def _usable(content: Mapping[str, Any], wrong: list[Violation]) -> dict[str, Any]:
    invalid = {violation.key.partition(".")[0] for violation in wrong}
    return {key: value for key, value in content.items() if key not in invalid}


def read_settings(root: Path) -> tuple[dict[str, Any], ImageOptions, list[Violation]]:
    """Return the valid entries of ``conversion.json``, its image options, and its violations.

    Default image options: the standard cameras.
    """
    absent = "this file (robocas import-robocas writes one)"
    content, wrong = read_object(root, FILE, absent=absent)
    if wrong:
        return {}, STANDARD, wrong
    version = content.get("schema_version", 1)
    if version != schema.SCHEMA_VERSION:
        expected = f"{schema.SCHEMA_VERSION} (convert the recording again)"
        return {}, STANDARD, [Violation(FILE, "schema_version", expected, str(version))]
    wrong = check_form(ConversionRecord, content, FILE)
    usable, image_options = _usable(content, wrong), STANDARD
    if usable.keys() >= {"cameras", "image_size", "depth", "image_format"}:
        size = tuple(content["image_size"]) if content["image_size"] else None
        try:
            image_options = ImageOptions(tuple(content["cameras"]), size, content["depth"], content["image_format"])
        except DatasetError as error:
            wrong.append(Violation(FILE, "", "valid image options", one_line(error)))
    first: dict[str, str] = {}
    for number, entry in usable.get("episodes", {}).items():
        other = first.setdefault(str(entry.get("recording") or number), number)
        if other != number:
            wrong.append(
                Violation(FILE, f"episodes.{number}", "each recording once", f"the recording of episode {other}")
            )
    return usable, image_options, wrong


def check_entries(
    settings: Mapping[str, Any], episodes: Mapping[int, tuple[EpisodeArrays, dict[str, Any]]]
) -> Iterator[Violation]:
    """Check that the settings list the episodes on disk, and that no two episodes have the same arrays."""
    entries = settings.get("episodes")
    for number, entry in (entries or {}).items():
        if int(number) not in episodes:
            file = entry.get("trajectory")
            fix = f" (convert {file} again, or with --append)" if file else ""
            yield Violation(FILE, f"episodes.{number}", "the episodes on disk", f"no folder{fix}")
    first: dict[str, str] = {}
    for number, (stored, scene) in episodes.items():
        name = schema.episode_folder(number)
        if entries is not None and str(number) not in entries:
            yield Violation(FILE, f"episodes.{number}", "an entry for each episode", "no entry")
        entry, known = (entries or {}).get(str(number), {}), valid_values(scene)[0]
        for key, expected, found in (
            ("source.recording", entry.get("recording"), known.get("source", {}).get("recording")),
            ("seed", parse_seed(entry.get("seed")), parse_seed(known.get("seed"))),
            ("rate_hz", settings.get("rate_hz"), known.get("rate_hz")),
        ):
            if None not in (expected, found) and expected != found:
                yield Violation(f"{name}/{schema.SCENE_FILE}", key, f"{expected} ({FILE})", str(found))
        if stored.arrays:
            other = first.setdefault(arrays_fingerprint(stored.arrays), name)
            if other != name:
                yield Violation(name, "", "each episode once", f"the arrays of {other}")
