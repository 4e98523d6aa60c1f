"""Checks how a dataset says it was made: ``conversion.json``, every episode's ``scene.json``, and no episode twice."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.content import EpisodeContent, read_object
from robocas_ms3.datasets.checks.scene_values import check_rate, check_settings_values, check_values
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.tolerant import arrays_fingerprint, first_line
from robocas_ms3.demos.recordings.seeds import one_seed

FILE = schema.CONVERSION_FILE


@dataclass(frozen=True)
class Settings:
    """``conversion.json``: its content, empty where it can't be used; which pictures it promises; what is wrong.

    Where it does not say properly which pictures there are, all are promised.
    """

    content: Mapping[str, Any]
    pictures: Pictures
    wrong: Sequence[Violation]


def read_settings(root: Path) -> Settings:
    """Read and check ``conversion.json``; one of another schema version can't be used."""
    absent = "this file (robocas import-robocas writes one)"
    found = read_object(root, FILE, expected="settings of a dataset", absent=absent)
    if found.wrong:
        return Settings({}, Pictures(), [found.wrong])
    content, version = found.content, found.content.get("schema_version", 1)
    if version != schema.SCHEMA_VERSION:
        expected = f"{schema.SCHEMA_VERSION} (convert it again from its recording)"
        return Settings({}, Pictures(), [Violation(FILE, "schema_version", expected, str(version))])
    wrong = check_settings_values(content)
    spoilt = {violation.key.partition(".")[0] for violation in wrong}
    marks = [] if "episodes" in spoilt else list(_check_marks(content.get("episodes", {})))
    if spoilt & {"cameras", "image_size", "depth", "image_format"}:
        return Settings(content, Pictures(), [*wrong, *marks])
    size = tuple(content["image_size"]) if content["image_size"] else None
    try:
        pictures = Pictures(tuple(content["cameras"]), size, content["depth"], content["image_format"])
    except DatasetError as error:
        other = Violation(FILE, "", "settings of a dataset", first_line(error))
        return Settings(content, Pictures(), [*wrong, other, *marks])
    return Settings(content, pictures, [*wrong, *marks])


def _check_marks(ledger: Mapping[str, Any]) -> Iterator[Violation]:
    firsts: dict[str, str] = {}
    for number, entry in ledger.items():
        first = firsts.setdefault(str(entry.get("recording") or number), number)
        if first != number:
            yield Violation(FILE, f"episodes.{number}", "each recording once", f"that of episode {first}")


def check_scene(content: EpisodeContent) -> Iterator[Violation]:
    """Check an episode's ``scene.json``."""
    file, scene = f"{content.name}/{schema.SCENE_FILE}", content.scene
    yield from [scene.wrong] if scene.wrong else check_values(scene.content, file)


def check_ledger(settings: Settings, episodes: Mapping[int, EpisodeContent]) -> Iterator[Violation]:
    """Check that the ledger lists the episodes on disk as they are, and that none has the arrays of another.

    Args:
        settings: ``conversion.json``.
        episodes: number -> content of the episodes on disk.
    """
    ledger = settings.content.get("episodes")
    ledger = ledger if isinstance(ledger, dict) else None
    rate_hz = None if check_rate(settings.content) else settings.content["rate_hz"]
    for number, entry in (ledger or {}).items():
        if not number.isdecimal() or int(number) not in episodes:
            yield Violation(FILE, f"episodes.{number}", "the episodes on disk", f"no folder{_way_back(entry)}")
    marks: dict[str, str] = {}
    for number, content in episodes.items():
        entry = (ledger or {}).get(str(number))
        if ledger is not None and str(number) not in ledger:
            yield Violation(FILE, f"episodes.{number}", "an entry of every episode", "none")
        yield from _told_apart(content, entry if isinstance(entry, dict) else {}, rate_hz)
        if content.stored.arrays:
            first = marks.setdefault(arrays_fingerprint(content.stored.arrays), content.name)
            if first != content.name:
                yield Violation(content.name, "", "each episode once", f"the arrays of {first}")


def _way_back(entry: Any) -> str:
    """How to get a missing episode, where its entry says which recording it is of."""
    file = entry.get("trajectory") if isinstance(entry, dict) else None
    return f" (convert {file} again, or with --append)" if file else ""


def _told_apart(content: EpisodeContent, entry: Mapping[str, Any], rate_hz: float | None) -> Iterator[Violation]:
    """Compare an episode's scene with ``conversion.json``; what one of them does not know can't differ."""
    scene = content.scene.content
    source = scene.get("source")
    pairs = {
        "source.recording": (entry.get("recording"), source.get("recording") if isinstance(source, dict) else None),
        "seed": (one_seed(entry.get("seed")), one_seed(scene.get("seed"))),
        "rate_hz": (rate_hz, None if check_rate(scene) else scene["rate_hz"]),
    }
    for key, (expected, found) in pairs.items():
        if None not in (expected, found) and expected != found:
            yield Violation(f"{content.name}/{schema.SCENE_FILE}", key, f"{expected} ({FILE})", str(found))
