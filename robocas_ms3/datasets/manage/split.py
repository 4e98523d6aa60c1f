"""Splits a dataset into several, or chooses its training and validation episodes again."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import write_json
from robocas_ms3.core.locks import locked_folder
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import arrays as laws
from robocas_ms3.datasets.conversion.data_info import info_of
from robocas_ms3.datasets.manage.copy_episodes import (
    KEEP_RULE,
    CopiedEpisode,
    CopyOptions,
    CopyResult,
    FinishedDataset,
    copy_episodes,
    damaged_episode,
)
from robocas_ms3.datasets.sources.arrays import read_arrays
from robocas_ms3.datasets.sources.reader import Dataset

By = Literal["seed", "target", "task"]
Sides = tuple[list[int], list[int]]
"""Numbers of the training and validation episodes."""


@dataclass(frozen=True)
class Share:
    """Fraction of the episodes that validate, and what stays on one side: episodes of a seed, target object or task."""

    val: float
    by: By = "seed"

    def __post_init__(self) -> None:
        if not 0 < self.val < 1:
            raise DatasetError("not a share", where="val_share", expected="> 0 and < 1", found=self.val)

    @property
    def rule(self) -> str:
        return f"{self.by}s in the order of sha256({self.by}), the first {self.val:g} of the episodes validate"


def groups_of(dataset: Dataset, by: By) -> dict[int, str]:
    """Return by episode number its seed, target object or task, as text."""
    groups = {}
    for number in dataset.numbers:
        scene = dataset.episode(number).scene
        target = scene.get("target") or {}
        value = {"seed": scene.get("seed"), "target": target.get("asset_id"), "task": scene.get("task")}[by]
        if value is None and by == "seed":
            value = number  # as in `info.summarize`
        if value is None:
            raise DatasetError(
                f"this episode does not say its {by}",
                where=dataset.root / schema.episode_folder(number) / schema.SCENE_FILE,
                fix="Choose another --by, or convert the episode's recording again.",
            )
        groups[number] = str(value)
    return groups


def cut(groups: Mapping[int, str], shares: Sequence[float], salt: str = "") -> list[list[int]]:
    """Cut episodes into parts of about these shares, which sum to 1, without cutting a group; no part is empty.

    Groups in the order of their SHA-256 fill the last part first, so the place of a group depends on the groups alone.
    Another salt gives an independent order.

    Raises:
        DatasetError: fewer groups than parts, or no shares.
    """
    if len(shares) < 2 or min(shares) <= 0 or abs(sum(shares) - 1) > 1e-6:
        raise DatasetError("not shares of a whole", expected="two or more, > 0, sum 1", found=list(shares))
    members: dict[str, list[int]] = {}
    for number, group in groups.items():
        members.setdefault(group, []).append(number)
    ranked = sorted(members, key=lambda group: hashlib.sha256(f"{salt}{group}".encode()).hexdigest())
    if len(ranked) < len(shares):
        raise DatasetError("too few to split", expected=f"{len(shares)} groups", found=len(ranked))
    parts: list[list[int]] = []
    for index in reversed(range(1, len(shares))):
        goal = round(shares[index] * len(groups))
        counts = np.cumsum([len(members[group]) for group in ranked[: len(ranked) - index]])
        taken = int(np.argmin(np.abs(counts - goal))) + 1
        parts.append(sorted(number for group in ranked[:taken] for number in members[group]))
        ranked = ranked[taken:]
    parts.append(sorted(number for group in ranked for number in members[group]))
    return parts[::-1]


def resplit(root: Path, share: Share | None = None) -> Sides:
    """Rewrite ``data_info.json`` from the episodes on disk, and return the sides; no episode is changed.

    Episodes that are not on disk are removed from ``conversion.json``.
    Without a share each episode keeps its side, and new ones are split by the rule of the writer.
    """
    with locked_folder(root):
        dataset = Dataset(root)
        sides = dataset.sides if share is None else _sides(dataset, share)
        for number in dataset.numbers:
            stored = read_arrays(dataset.episode(number).folder / schema.EPISODE_FILE)
            for wrong in laws.violations_of(stored, (laws.check_file, laws.check_finite)):
                raise damaged_episode(root, wrong)
        info, settings = info_of(root, sides), dataset.settings
        new = {**settings, **({} if share is None else {"split": share.rule})}
        if "episodes" in settings:
            there = set(map(str, dataset.numbers))
            new["episodes"] = {number: entry for number, entry in settings["episodes"].items() if number in there}
        if settings and new != settings:
            write_json(root / schema.CONVERSION_FILE, new)
        write_json(root / schema.DATA_INFO_FILE, info)
    return info["train_eps"], info["val_eps"]


def split_by_side(source: FinishedDataset, share: Share | None, train: Path, val: Path) -> dict[Path, Sides]:
    """Return the sides of the episodes of two datasets: training and validation."""
    a, b = train.resolve(), val.resolve()
    if a == b or a in b.parents or b in a.parents:
        raise DatasetError("two datasets in one folder", where=val, fix="Choose two that are apart.")
    sides = source.dataset.sides if share is None else _sides(source.dataset, share)
    return {train: (sides[0], []), val: ([], sides[1])}


def split_by_fractions(dataset: Dataset, shares: Sequence[float], by: By, share: Share | None) -> dict[str, Sides]:
    """Return the sides of the episodes of datasets ``part_0``, ... of these shares."""
    # With the salt of the sides, the last part would get all validation episodes.
    pieces = cut(groups_of(dataset, by), shares, salt="part ")
    return {f"part_{index}": _within(dataset, piece, share) for index, piece in enumerate(pieces)}


def split_by_value(dataset: Dataset, by: By, share: Share | None) -> dict[str, Sides]:
    """Return the sides of the episodes of one dataset per task or target object, by its folder."""
    groups = groups_of(dataset, by)
    pieces = {value: [n for n, group in groups.items() if group == value] for value in sorted(set(groups.values()))}
    names = folder_names(pieces)
    return {names[value]: _within(dataset, piece, share) for value, piece in pieces.items()}


def folder_names(values: Iterable[str]) -> dict[str, str]:
    plain = {value: re.sub(r"[^\w.-]+", "_", value).strip(".")[:40] or "_" for value in values}
    shared = Counter(plain.values())
    return {
        value: name if shared[name] == 1 else f"{name}-{hashlib.sha256(value.encode()).hexdigest()[:8]}"
        for value, name in plain.items()
    }


def write_split(
    source: FinishedDataset, pieces: Mapping[Path, Sides], share: Share | None, options: CopyOptions | None = None
) -> list[CopyResult]:
    """Write the datasets of a split, by their folders; ``share``: how the sides were chosen, None: as in the source."""
    members: dict[Path, list[CopiedEpisode]] = {}
    for out, (train, val) in pieces.items():
        if not train and not val:
            raise DatasetError("no episodes for this part", where=out, fix="Choose other shares.")
        validates = set(val)
        members[out] = [
            CopiedEpisode(source, number, "val" if number in validates else "train")
            for number in sorted([*train, *val])
        ]
    return copy_episodes(members, share.rule if share else KEEP_RULE, options or CopyOptions())


def _within(dataset: Dataset, numbers: list[int], share: Share | None) -> Sides:
    if share is not None and len(numbers) > 1:
        groups = groups_of(dataset, share.by)
        train, val = cut({number: groups[number] for number in numbers}, [1 - share.val, share.val])
        return train, val
    chosen = set(numbers)
    train, val = ([number for number in side if number in chosen] for side in dataset.sides)
    return train, val


def _sides(dataset: Dataset, share: Share) -> Sides:
    train, val = cut(groups_of(dataset, share.by), [1 - share.val, share.val])
    return train, val
