"""Checks the episodes that a dataset is made of, before anything is written."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import arrays as laws
from robocas_ms3.datasets.checks.content import SURPLUS, EpisodeContent, read_episode
from robocas_ms3.datasets.checks.pictures import check_cameras, check_pictures
from robocas_ms3.datasets.checks.scene import read_settings
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.manage.parts import Part
from robocas_ms3.datasets.pictures.headers import PictureHeader, has_both_ends, read_header
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.tolerant import SPECS, read_arrays


def check_episodes(part: Part, numbers: Iterable[int]) -> None:
    """Check that episodes have all their arrays, cameras and pictures; not what the arrays and pictures say.

    Arrays that an imported dataset says it lacks may be missing. Of a picture only both ends are read.

    Raises:
        DatasetError: one is damaged.
    """
    pictures = read_settings(part.root).pictures
    for number in numbers:
        content = read_episode(part.root / schema.episode_folder(number), pictures, look_at_ends)
        _refuse(part.root, _violations(content, pictures))


def check_numbers(dataset: Dataset) -> None:
    """Check that all arrays of all episodes can be read, and are finite numbers.

    Raises:
        DatasetError: one is not.
    """
    for number in dataset.numbers:
        stored = read_arrays(dataset.episode(number).folder / schema.EPISODE_FILE)
        _refuse(dataset.root, laws.violations_of(stored, (laws.check_file, laws.check_finite)))


def _refuse(root: Path, violations: Iterable[Violation]) -> None:
    for wrong in violations:
        where = f"{root / wrong.file}{f', {wrong.key}' if wrong.key else ''}"
        fix = f"robocas validate {root} lists all."
        raise DatasetError("this episode is damaged", where=where, expected=wrong.expected, found=wrong.found, fix=fix)


def _violations(content: EpisodeContent, pictures: Pictures) -> Iterable[Violation]:
    source = content.scene.content.get("source")
    missing = source.get("missing") if isinstance(source, dict) else None
    lacking = missing if isinstance(missing, list) else []  # arrays that an imported episode says it lacks
    yield from (v for v in laws.check_keys(content.stored) if v.key in SPECS and v.key not in lacking)
    yield from laws.violations_of(content.stored, (laws.check_file, laws.check_shapes, laws.check_finite))
    yield from check_cameras(content, pictures)
    images = check_pictures(content.headers, content.name, pictures, {})
    yield from (wrong for wrong in images if wrong.found != SURPLUS)


def look_at_ends(path: Path) -> PictureHeader | None:
    """Look at both ends of a picture; what is not as it should be there is read whole.

    Raises:
        ValueError: it is damaged or not a regular file.
        OSError: it can't be read.
    """
    if not has_both_ends(path):
        read_header(path)
    return None
