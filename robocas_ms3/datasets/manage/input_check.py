"""Checks the episodes that a dataset is made of, before anything is written."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.arrays import check_shapes
from robocas_ms3.datasets.checks.pictures import check_cameras
from robocas_ms3.datasets.checks.scene import check_settings
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.manage.parts import Part
from robocas_ms3.datasets.pictures.headers import read_header
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.reader import Dataset, Episode
from robocas_ms3.datasets.sources.tolerant import DAMAGED, PICKLED, first_line
from robocas_ms3.errors import DatasetError

_TAIL = 32  # bytes at the end of a picture that are looked at


def check_episodes(part: Part, numbers: Iterable[int]) -> None:
    """Check that episodes have all their arrays, cameras and pictures; not what the arrays and pictures say.

    Arrays that an imported dataset says it lacks may be missing. Of a picture only both ends are read.

    Raises:
        DatasetError: one is damaged.
    """
    pictures, _ = check_settings(part.root)
    for number in numbers:
        _refuse(part.root, _episode(part.dataset.episode(number), pictures))


def check_numbers(dataset: Dataset) -> None:
    """Check that all arrays of all episodes can be read, and are finite numbers.

    Raises:
        DatasetError: one is not.
    """
    for number in dataset.numbers:
        _refuse(dataset.root, _arrays(dataset.episode(number), {}))


def _refuse(root: Path, violations: Iterator[Violation]) -> None:
    for wrong in violations:
        where = f"{root / wrong.file}{f', {wrong.key}' if wrong.key else ''}"
        fix = f"robocas validate {root} lists all."
        raise DatasetError("this episode is damaged", where=where, expected=wrong.expected, found=wrong.found, fix=fix)


def _episode(episode: Episode, pictures: Pictures) -> Iterator[Violation]:
    arrays: dict[str, NDArray] = {}
    yield from _arrays(episode, arrays)
    name = episode.folder.name
    file = f"{name}/{schema.EPISODE_FILE}"
    if "ee_pos" not in arrays:
        yield Violation(file, "ee_pos", "this key", "no such key")
        return
    steps = len(np.atleast_1d(arrays["ee_pos"]))
    known = {spec.name for spec in schema.EPISODE_INFO}
    for violation in check_shapes(file, arrays, steps):
        if violation.key in known and (violation.key in arrays or violation.key not in _lacking(episode)):
            yield violation
    if "episode_length" in arrays and arrays["episode_length"] != steps:
        yield Violation(file, "episode_length", f"{steps}, as ee_pos has", str(arrays["episode_length"]))
    yield from check_cameras(episode.folder, {}, pictures)
    for camera in pictures.cameras:
        for kind in pictures.kinds:
            for step in range(steps):
                path = schema.image_path(episode.folder, camera, kind, step, pictures.image_format)
                problem = _picture(path)
                if problem:
                    yield Violation(f"{name}/{camera}/{kind}/{path.name}", "", "a sound picture", problem)


def _lacking(episode: Episode) -> list[str]:
    """Arrays that an imported episode says it lacks."""
    source = episode.scene.get("source")
    missing = source.get("missing") if isinstance(source, dict) else None
    return missing if isinstance(missing, list) else []


def _arrays(episode: Episode, arrays: dict[str, NDArray]) -> Iterator[Violation]:
    """Read all arrays, into ``arrays``."""
    file = f"{episode.folder.name}/{schema.EPISODE_FILE}"
    key = ""
    try:
        with np.load(episode.folder / schema.EPISODE_FILE, allow_pickle=False) as content:
            for key in content.files:
                arrays[key] = content[key]
                wrong = np.sum(~np.isfinite(arrays[key])) if arrays[key].dtype.kind == "f" else 0
                if wrong:
                    yield Violation(file, key, "finite numbers", f"{wrong} others")
    except FileNotFoundError:
        yield Violation(file, "", "this file", "no file")
    except (*DAMAGED, MemoryError, TypeError) as error:  # TypeError: a single array, not an archive
        text = first_line(error)
        pickled = PICKLED if key else "another file, or pickles"
        yield Violation(file, key, "arrays without pickles", pickled if "pickle" in text else text)


def _picture(path: Path) -> str:
    """What is wrong with a picture; those whose ends are as they should be are not read."""
    try:
        with path.open("rb") as file:
            head = file.read(_TAIL)
            size = os.fstat(file.fileno()).st_size
            file.seek(max(0, size - _TAIL))
            tail = file.read()
        if not _has_ends(path.suffix, head, tail, size):
            read_header(path)
    except FileNotFoundError:
        return "no file"
    except (OSError, ValueError) as error:
        return first_line(error)
    return ""


def _has_ends(suffix: str, head: bytes, tail: bytes, size: int) -> bool:
    if suffix == ".png":
        return head.startswith(b"\x89PNG\r\n\x1a\n") and tail.endswith(b"\0\0\0\0IEND\xaeB`\x82")
    if suffix == ".jpg":
        return head.startswith(b"\xff\xd8\xff") and tail.endswith(b"\xff\xd9")
    return head.startswith(b"RIFF") and head[8:12] == b"WEBP" and size == 8 + int.from_bytes(head[4:8], "little")
