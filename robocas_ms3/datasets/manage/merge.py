"""Merge several datasets into one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.conversion.episode_plan import SETTINGS_KEYS
from robocas_ms3.datasets.manage.copy_episodes import (
    KEEP_RULE,
    CopiedEpisode,
    CopyOptions,
    CopyResult,
    FinishedDataset,
    copy_episodes,
    open_finished_dataset,
)


def merge(
    roots: Sequence[Path], out: Path, *, skip_duplicates: bool = False, options: CopyOptions | None = None
) -> CopyResult:
    """Merge all episodes of several datasets into a new dataset.

    Episodes are numbered from 0 in the order of ``roots``, and keep their split.

    Raises:
        DatasetError: a dataset is unfinished or damaged, the settings differ, or, without ``skip_duplicates``, an
            episode is in several datasets.
        OutputExistsError: ``out`` is a dataset that a different call wrote (unless ``options.overwrite``), or a
            folder with other content.
    """
    if not roots:
        what, fix = "missing dataset folders", "Run robocas merge A B --out C."
        raise DatasetError(what, where="DIR", expected="folders of datasets", fix=fix, usage=True)
    sources = [open_finished_dataset(root, name) for root, name in zip(roots, _distinct_names(roots), strict=True)]
    _check_settings(sources)
    members: dict[str, CopiedEpisode] = {}
    duplicates: list[tuple[CopiedEpisode, CopiedEpisode]] = []
    for source in sources:
        validation = set(source.dataset.splits[1])
        for number in source.dataset.numbers:
            member = CopiedEpisode(source, number, "val" if number in validation else "train")
            first = members.setdefault(source.recording_id(number), member)
            if first is not member:
                duplicates.append((first, member))
    if duplicates and not skip_duplicates:
        pairs = [f"{a.source.name} {a.number} = {b.source.name} {b.number}" for a, b in duplicates]
        where, found = ", ".join(map(str, roots)), f"{len(duplicates)}: {', '.join(pairs[:4])}"
        fix = "Pass --skip-duplicates to keep one copy of each."
        raise DatasetError("duplicate recordings", where=where, found=found, fix=fix)
    (written,) = copy_episodes({out: list(members.values())}, KEEP_RULE, options or CopyOptions())
    return replace(written, skipped=len(duplicates))


def _distinct_names(roots: Sequence[Path]) -> list[str]:
    """Return a distinct name per path: its last folder, or as many last folders as needed."""
    parts = [root.resolve().parts for root in roots]
    names: list[str] = []
    for length in range(1, max(map(len, parts)) + 1):
        names = [str(Path(*path[-length:])) for path in parts]
        if len(set(names)) == len(names):
            break
    return names


def _check_settings(sources: Sequence[FinishedDataset]) -> None:
    first = sources[0].dataset
    for other in (source.dataset for source in sources[1:]):
        different = [key for key in SETTINGS_KEYS if first.settings.get(key) != other.settings.get(key)]
        if different:
            raise DatasetError(
                "the settings of the datasets differ",
                where=other.root / schema.CONVERSION_FILE,
                expected=", ".join(f"{key} {first.settings.get(key)}" for key in different) + f" as in {first.root}",
                found=", ".join(f"{key} {other.settings.get(key)}" for key in different),
                fix="Convert them with the same settings.",
            )
