"""Checks how a dataset says it was made: ``conversion.json``, every episode's ``scene.json``, and no episode twice."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures import Pictures
from robocas_ms3.datasets.tolerant import arrays_fingerprint
from robocas_ms3.datasets.violation import Violation
from robocas_ms3.errors import DatasetError

FILE = schema.CONVERSION_FILE


def check_settings(root: Path) -> tuple[Pictures, list[Violation]]:
    """Check ``conversion.json``, and tell which pictures it promises (all of them, where it can't be read)."""
    try:
        settings = json.loads((root / FILE).read_text(encoding="utf-8"))
        version = settings.get("schema_version", 1)
        if version != schema.SCHEMA_VERSION:
            return Pictures(), [
                Violation(FILE, "schema_version", f"{schema.SCHEMA_VERSION} (robocas upgrade)", str(version))
            ]
        size = settings["image_size"]
        pictures = Pictures(
            tuple(settings["cameras"]), tuple(size) if size else None, settings["depth"], settings["image_format"]
        )
    except FileNotFoundError:
        return Pictures(), [Violation(FILE, "", "this file (robocas import-robocas or upgrade writes one)", "no file")]
    except KeyError as error:
        return Pictures(), [Violation(FILE, str(error).strip("'"), "this key", "no such key")]
    except (OSError, ValueError, TypeError, AttributeError, DatasetError) as error:
        return Pictures(), [Violation(FILE, "", "settings of a dataset", str(error).splitlines()[0])]
    problems = []
    marks: dict[str, str] = {}
    for number, entry in settings.get("episodes", {}).items():
        mark = entry.get("recording") or number
        if mark in marks:
            problems.append(
                Violation(FILE, f"episodes.{number}", "each recording once", f"that of episode {marks[mark]}")
            )
        marks.setdefault(mark, number)
    return pictures, problems


def check_scene(folder: Path, arrays: Mapping[str, NDArray]) -> Iterator[Violation]:
    """Check an episode's ``scene.json``."""
    file = f"{folder.name}/{schema.SCENE_FILE}"
    try:
        scene: Any = json.loads((folder / schema.SCENE_FILE).read_text(encoding="utf-8"))
    except FileNotFoundError:
        yield Violation(file, "", "this file", "no file")
        return
    except (OSError, ValueError) as error:
        yield Violation(file, "", "JSON", str(error).splitlines()[0])
        return
    if not isinstance(scene, dict):
        yield Violation(file, "", "an object", type(scene).__name__)
        return
    for key in schema.SCENE:
        if key not in scene:
            yield Violation(file, key, "this key", "no such key")
    if scene.get("schema_version") != schema.SCHEMA_VERSION:
        yield Violation(file, "schema_version", str(schema.SCHEMA_VERSION), str(scene.get("schema_version")))


def check_ledger(root: Path, episodes: Mapping[int, Mapping[str, NDArray]]) -> Iterator[Violation]:
    """Check that the ledger lists the episodes on disk as they are, and that none has the arrays of another.

    Args:
        root: the dataset.
        episodes: number -> arrays of the episodes on disk, as far as they could be read.
    """
    try:
        settings = json.loads((root / FILE).read_text(encoding="utf-8"))
        ledger = settings["episodes"] if settings.get("schema_version") == schema.SCHEMA_VERSION else None
    except (OSError, ValueError, KeyError, AttributeError):
        ledger = None  # said already
    for number, entry in ledger.items() if isinstance(ledger, dict) else ():
        if not number.isdecimal() or int(number) not in episodes:
            yield Violation(FILE, f"episodes.{number}", "the episodes on disk", "no folder (convert with --resume?)")
        elif isinstance(entry, dict):
            yield from _told_apart(root / schema.episode_folder(int(number)), entry)
    marks: dict[str, int] = {}
    for number, arrays in episodes.items():
        name = schema.episode_folder(number)
        if isinstance(ledger, dict) and str(number) not in ledger:
            yield Violation(FILE, f"episodes.{number}", "an entry of every episode", "none")
        if not arrays:
            continue
        first = marks.setdefault(arrays_fingerprint(arrays), number)
        if first != number:
            yield Violation(name, "", "each episode once", f"the arrays of {schema.episode_folder(first)}")


def _told_apart(folder: Path, entry: Mapping[str, Any]) -> Iterator[Violation]:
    """Compare an episode's scene with its entry of the ledger; what one of them does not know can't differ."""
    try:
        scene = json.loads((folder / schema.SCENE_FILE).read_text(encoding="utf-8"))
        source = scene.get("source") or {}
        pairs = {"source.recording": (entry.get("recording"), source.get("recording"))}
        pairs["seed"] = (entry.get("seed"), scene.get("seed"))
    except (OSError, ValueError, AttributeError):
        return  # said already
    for key, (expected, found) in pairs.items():
        if None not in (expected, found) and expected != found:
            yield Violation(f"{folder.name}/{schema.SCENE_FILE}", key, f"{expected} ({FILE})", str(found))
