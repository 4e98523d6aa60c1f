"""Several datasets as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.manage.assemble import Assembly, Member, OnEpisode, OnStart, Side, assemble, check_before
from robocas_ms3.datasets.manage.parts import Part, names_of, open_part, shown
from robocas_ms3.datasets.writing.plan import SETTINGS

SPLIT_RULE = "every episode keeps the side it had in the dataset it is from"


@dataclass(frozen=True)
class MergeResult:
    """What was done: the new dataset, and how many duplicates were left out."""

    written: Assembly
    skipped: int


def merge(
    roots: Sequence[Path],
    out: Path,
    *,
    skip_duplicates: bool = False,
    link: bool = True,
    overwrite: bool = False,
    on_start: OnStart | None = None,
    on_episode: OnEpisode | None = None,
) -> MergeResult:
    """Write a dataset of all episodes of others, in the order given, numbered anew; the split stays as it was.

    Args:
        roots: the datasets, of the same schema version and settings.
        out: folder of the new one.
        skip_duplicates: take an episode that is there already once, instead of refusing.
        link, overwrite, on_start, on_episode: see `assemble`.

    Raises:
        DatasetError: they do not fit together, are not finished, or an episode is damaged.
        OutputExistsError: ``out`` is another dataset, or none.
    """
    if not roots:
        raise DatasetError("nothing to merge", expected="folders of datasets", fix="robocas merge A B --out C")
    parts = [open_part(root) for root in roots]
    _check_settings(parts)
    members: list[Member] = []
    seen: dict[str, Member] = {}
    duplicates: list[tuple[Member, Member]] = []
    for part, name in zip(parts, names_of(roots), strict=True):
        validates = set(part.sides[1])
        for number in part.dataset.numbers:
            side: Side = "val" if number in validates else "train"
            member = Member(part, name, number, side)
            first = seen.setdefault(part.identity(number), member)
            if first is member:
                members.append(member)
            else:
                duplicates.append((first, member))
    if duplicates and not skip_duplicates:
        pairs = (f"{a.name} {a.number} = {b.name} {b.number}" for a, b in duplicates)
        raise DatasetError(
            "the same recording twice",
            where=", ".join(map(str, roots)),
            found=f"{len(duplicates)}: {shown(pairs, 4)}",
            fix="Pass --skip-duplicates to take each once.",
        )
    check_before({out: members}, SPLIT_RULE, overwrite=overwrite)
    written = assemble(
        out,
        members,
        split_rule=SPLIT_RULE,
        link=link,
        overwrite=overwrite,
        on_start=on_start,
        on_episode=on_episode,
    )
    return MergeResult(written, len(duplicates))


def _check_settings(parts: Sequence[Part]) -> None:
    first = parts[0]
    for other in parts[1:]:
        different = [key for key in SETTINGS if first.settings.get(key) != other.settings.get(key)]
        if different:
            raise DatasetError(
                "these datasets have other settings",
                where=other.root / schema.CONVERSION_FILE,
                expected=", ".join(f"{key} {first.settings.get(key)}" for key in different) + f" as {first.root}",
                found=", ".join(f"{key} {other.settings.get(key)}" for key in different),
                fix="Convert them with the same settings.",
            )
