"""Merges several datasets into one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.conversion.episode_plan import SETTINGS
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
    """Write a dataset of all episodes of others, in the given order; each keeps its side of the split.

    Raises:
        DatasetError: the datasets are not finished or have other settings or, without ``skip_duplicates``, the same
            episodes, or an episode is damaged.
        OutputExistsError: ``out`` is another dataset, or none.
    """
    if not roots:
        raise DatasetError("nothing to merge", expected="folders of datasets", fix="robocas merge A B --out C")
    sources = [open_finished_dataset(root, name) for root, name in zip(roots, _distinct_names(roots), strict=True)]
    _check_settings(sources)
    members: dict[str, CopiedEpisode] = {}
    duplicates: list[tuple[CopiedEpisode, CopiedEpisode]] = []
    for source in sources:
        validates = set(source.dataset.splits[1])
        for number in source.dataset.numbers:
            member = CopiedEpisode(source, number, "val" if number in validates else "train")
            first = members.setdefault(source.identity(number), member)
            if first is not member:
                duplicates.append((first, member))
    if duplicates and not skip_duplicates:
        pairs = [f"{a.source.name} {a.number} = {b.source.name} {b.number}" for a, b in duplicates]
        where, found = ", ".join(map(str, roots)), f"{len(duplicates)}: {', '.join(pairs[:4])}"
        fix = "Pass --skip-duplicates to take each once."
        raise DatasetError("the same recording twice", where=where, found=found, fix=fix)
    (written,) = copy_episodes({out: list(members.values())}, KEEP_RULE, options or CopyOptions())
    return replace(written, skipped=len(duplicates))


def _distinct_names(roots: Sequence[Path]) -> list[str]:
    """Return the shortest ends of paths that differ."""
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
        different = [key for key in SETTINGS if first.settings.get(key) != other.settings.get(key)]
        if different:
            raise DatasetError(
                "these datasets have other settings",
                where=other.root / schema.CONVERSION_FILE,
                expected=", ".join(f"{key} {first.settings.get(key)}" for key in different) + f" as {first.root}",
                found=", ".join(f"{key} {other.settings.get(key)}" for key in different),
                fix="Convert them with the same settings.",
            )
