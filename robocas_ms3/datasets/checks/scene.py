"""Checks how a dataset says it was made: ``conversion.json``, every episode's ``scene.json``, and no episode twice."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.scene_values import check_rate, check_settings_values, check_values
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.tolerant import arrays_fingerprint
from robocas_ms3.errors import DatasetError
from robocas_ms3.recordings.seeds import one_seed

FILE = schema.CONVERSION_FILE


def check_settings(root: Path) -> tuple[Pictures, list[Violation]]:
    """Check ``conversion.json``, and tell which pictures it promises (all of them, where it can't be read)."""
    try:
        settings = json.loads((root / FILE).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return Pictures(), [Violation(FILE, "", "this file (robocas import-robocas writes one)", "no file")]
    except (OSError, ValueError) as error:
        return Pictures(), [Violation(FILE, "", "settings of a dataset", str(error).splitlines()[0])]
    if not isinstance(settings, dict):
        return Pictures(), [Violation(FILE, "", "an object", type(settings).__name__)]
    version = settings.get("schema_version", 1)
    if version != schema.SCHEMA_VERSION:
        expected = f"{schema.SCHEMA_VERSION} (convert it again from its recording)"
        return Pictures(), [Violation(FILE, "schema_version", expected, str(version))]
    problems = check_settings_values(settings)
    pictures = Pictures()
    if not {problem.key.partition(".")[0] for problem in problems} & {"cameras", "image_size", "depth", "image_format"}:
        size = settings["image_size"]
        try:
            pictures = Pictures(
                tuple(settings["cameras"]), tuple(size) if size else None, settings["depth"], settings["image_format"]
            )
        except DatasetError as error:
            problems.append(Violation(FILE, "", "settings of a dataset", str(error).splitlines()[0]))
    if any(problem.key.startswith("episodes") for problem in problems):
        return pictures, problems
    marks: dict[str, str] = {}
    for number, entry in settings.get("episodes", {}).items():
        mark = str(entry.get("recording") or number)
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
    wrong = check_values(scene, file)
    yield from wrong
    try:
        json.dumps(scene, allow_nan=False)
    except ValueError:
        if not wrong:  # where the schema asks for a number it is said already
            yield Violation(file, "", "JSON, which knows finite numbers only", "NaN or Infinity")


def check_ledger(root: Path, episodes: Mapping[int, Mapping[str, NDArray]]) -> Iterator[Violation]:
    """Check that the ledger lists the episodes on disk as they are, and that none has the arrays of another.

    Args:
        root: the dataset.
        episodes: number -> arrays of the episodes on disk, as far as they could be read.
    """
    settings = _settings(root)
    ledger, rate_hz = settings.get("episodes"), None if check_rate(settings) else settings["rate_hz"]
    for number, entry in ledger.items() if isinstance(ledger, dict) else ():
        if not number.isdecimal() or int(number) not in episodes:
            found = f"no folder{_way_back(entry)}"
            yield Violation(FILE, f"episodes.{number}", "the episodes on disk", found)
    marks: dict[str, int] = {}
    for number, arrays in episodes.items():
        name = schema.episode_folder(number)
        entry = ledger.get(str(number)) if isinstance(ledger, dict) else None
        if isinstance(ledger, dict) and str(number) not in ledger:
            yield Violation(FILE, f"episodes.{number}", "an entry of every episode", "none")
        yield from _told_apart(root / name, entry if isinstance(entry, dict) else {}, rate_hz)
        if not arrays:
            continue
        first = marks.setdefault(arrays_fingerprint(arrays), number)
        if first != number:
            yield Violation(name, "", "each episode once", f"the arrays of {schema.episode_folder(first)}")


def _way_back(entry: Any) -> str:
    """How to get a missing episode, where its entry says which recording it is of."""
    file = entry.get("trajectory") if isinstance(entry, dict) else None
    return f" (convert {file} again with --append or --resume)" if file else ""


def _settings(root: Path) -> dict[str, Any]:
    """``conversion.json``; empty where there is none of today's."""
    try:
        settings = json.loads((root / FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if not isinstance(settings, dict) or settings.get("schema_version") != schema.SCHEMA_VERSION:
        return {}
    return settings


def _told_apart(folder: Path, entry: Mapping[str, Any], rate_hz: float | None) -> Iterator[Violation]:
    """Compare an episode's scene with ``conversion.json``; what one of them does not know can't differ."""
    try:
        scene = json.loads((folder / schema.SCENE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return  # said already
    if not isinstance(scene, dict):
        return
    source = scene.get("source")
    pairs = {
        "source.recording": (entry.get("recording"), source.get("recording") if isinstance(source, dict) else None),
        "seed": (one_seed(entry.get("seed")), one_seed(scene.get("seed"))),
        "rate_hz": (rate_hz, None if check_rate(scene) else scene["rate_hz"]),
    }
    for key, (expected, found) in pairs.items():
        if None not in (expected, found) and expected != found:
            yield Violation(f"{folder.name}/{schema.SCENE_FILE}", key, f"{expected} ({FILE})", str(found))
