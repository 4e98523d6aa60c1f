"""Split a dataset into several datasets, or choose its training and validation episodes again."""

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
from robocas_ms3.core.locks import lock_folder
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import arrays as array_checks
from robocas_ms3.datasets.conversion.data_info import build_data_info
from robocas_ms3.datasets.manage.copy_episodes import (
    KEEP_RULE,
    CopiedEpisode,
    CopyOptions,
    CopyResult,
    FinishedDataset,
    copy_episodes,
    damaged_episode_error,
)
from robocas_ms3.datasets.sources.arrays import read_arrays
from robocas_ms3.datasets.sources.reader import Dataset

GroupBy = Literal["seed", "target", "task"]
EpisodeSplit = tuple[list[int], list[int]]
"""Numbers of the training and validation episodes."""


@dataclass(frozen=True)
class SplitOptions:
    """Options of a new choice of validation episodes.

    Attributes:
        val_fraction: fraction of the episodes for validation, between 0 and 1.
        group_by: episodes with the same seed, target object or task stay in one split.
    """

    val_fraction: float
    group_by: GroupBy = "seed"

    def __post_init__(self) -> None:
        if not 0 < self.val_fraction < 1:
            expected = "> 0 and < 1"
            raise DatasetError("invalid fraction", where="val_fraction", expected=expected, found=self.val_fraction)

    @property
    def rule(self) -> str:
        """Description of the split for ``conversion.json``."""
        return (
            f"{self.group_by}s in the order of sha256({self.group_by}); the first {self.val_fraction:g} of the episodes"
            " is for validation"
        )


def group_episodes(dataset: Dataset, group_by: GroupBy) -> dict[int, str]:
    """Return the seed, target object or task of each episode as text, by episode number."""
    groups = {}
    for number in dataset.numbers:
        scene = dataset.episode(number).scene
        target = scene.get("target") or {}
        value = {"seed": scene.get("seed"), "target": target.get("asset_id"), "task": scene.get("task")}[group_by]
        if value is None and group_by == "seed":
            value = number  # as in `data_info.build_data_info`
        if value is None:
            raise DatasetError(
                f"unknown {group_by} of an episode",
                where=dataset.root / schema.episode_folder(number) / schema.SCENE_FILE,
                fix="Choose another --group-by, or convert the recording of the episode again.",
            )
        groups[number] = str(value)
    return groups


def divide_episodes(groups: Mapping[int, str], fractions: Sequence[float], salt: str = "") -> list[list[int]]:
    """Divide episodes into lists with about the given fractions; a group stays in one list.

    ``fractions`` sum to 1. ``groups``: group of each episode, by number. No list is empty. The groups are sorted by
    their SHA-256 and fill the last list first, so the result depends on the groups alone. Another ``salt`` gives an
    independent order.

    Raises:
        DatasetError: there are fewer groups than fractions, or the fractions are invalid.
    """
    check_fractions(fractions)
    members: dict[str, list[int]] = {}
    for number, group in groups.items():
        members.setdefault(group, []).append(number)
    ranked = sorted(members, key=lambda group: hashlib.sha256(f"{salt}{group}".encode()).hexdigest())
    if len(ranked) < len(fractions):
        what, expected = "too few groups of episodes to split", f"at least {len(fractions)} groups"
        raise DatasetError(what, expected=expected, found=len(ranked))
    pieces: list[list[int]] = []
    for index in reversed(range(1, len(fractions))):
        goal = round(fractions[index] * len(groups))
        counts = np.cumsum([len(members[group]) for group in ranked[: len(ranked) - index]])
        taken = int(np.argmin(np.abs(counts - goal))) + 1
        pieces.append(sorted(number for group in ranked[:taken] for number in members[group]))
        ranked = ranked[taken:]
    pieces.append(sorted(number for group in ranked for number in members[group]))
    return pieces[::-1]


def check_fractions(fractions: Sequence[float], where: str = "fractions") -> None:
    """Raise DatasetError unless there are two or more fractions > 0 with the sum 1."""
    if len(fractions) < 2 or min(fractions) <= 0 or abs(sum(fractions) - 1) > 1e-6:
        expected = "two or more, each > 0, sum 1"
        raise DatasetError("invalid fractions", where=where, expected=expected, found=list(fractions))


def resplit(root: Path, options: SplitOptions | None = None) -> EpisodeSplit:
    """Write ``data_info.json`` again from the episodes on disk; return the new split.

    Episodes do not change. Episodes that are not on disk are removed from ``conversion.json``. Without options each
    episode keeps its split; episodes that ``data_info.json`` did not list are split by seed.
    """
    with lock_folder(root):
        dataset = Dataset(root)
        split = dataset.splits if options is None else _choose_split(dataset, options)
        for number in dataset.numbers:
            stored = read_arrays(dataset.episode(number).folder / schema.EPISODE_FILE)
            for wrong in array_checks.run_checks(stored, (array_checks.check_file, array_checks.check_finite)):
                raise damaged_episode_error(root, wrong)
        info, settings = build_data_info(root, split), dataset.settings
        new = {**settings, **({} if options is None else {"split": options.rule})}
        if "episodes" in settings:
            on_disk = set(map(str, dataset.numbers))
            new["episodes"] = {number: entry for number, entry in settings["episodes"].items() if number in on_disk}
        if settings and new != settings:
            write_json(root / schema.CONVERSION_FILE, new)
        write_json(root / schema.DATA_INFO_FILE, info)
    return info["train_eps"], info["val_eps"]


def split_train_val(
    source: FinishedDataset, options: SplitOptions | None, train: Path, val: Path
) -> dict[Path, EpisodeSplit]:
    """Choose the episodes of a training and a validation dataset; return both splits by output folder."""
    a, b = train.resolve(), val.resolve()
    if a == b or a in b.parents or b in a.parents:
        fix = "Choose two folders, neither inside the other."
        raise DatasetError("the training folder overlaps the validation folder", where=val, found=train, fix=fix)
    split = source.dataset.splits if options is None else _choose_split(source.dataset, options)
    return {train: (split[0], []), val: ([], split[1])}


def split_by_fractions(
    dataset: Dataset, fractions: Sequence[float], group_by: GroupBy, options: SplitOptions | None
) -> dict[str, EpisodeSplit]:
    """Choose the episodes of datasets with these fractions; return their splits by folder ``part_0``, ..."""
    # With the salt of the validation split, the last dataset would get all validation episodes.
    pieces = divide_episodes(group_episodes(dataset, group_by), fractions, salt="part ")
    return {f"part_{index}": _split_within(dataset, piece, options) for index, piece in enumerate(pieces)}


def split_by_value(dataset: Dataset, group_by: GroupBy, options: SplitOptions | None) -> dict[str, EpisodeSplit]:
    """Choose the episodes of one dataset per task or target object; return their splits by folder name."""
    groups = group_episodes(dataset, group_by)
    pieces = {value: [n for n, group in groups.items() if group == value] for value in sorted(set(groups.values()))}
    names = make_folder_names(pieces)
    return {names[value]: _split_within(dataset, piece, options) for value, piece in pieces.items()}


def make_folder_names(values: Iterable[str]) -> dict[str, str]:
    """Make a distinct folder name of at most 49 characters for each value."""
    plain = {value: re.sub(r"[^\w.-]+", "_", value).strip(".")[:40] or "_" for value in values}
    shared = Counter(plain.values())
    return {
        value: name if shared[name] == 1 else f"{name}-{hashlib.sha256(value.encode()).hexdigest()[:8]}"
        for value, name in plain.items()
    }


def write_split(
    source: FinishedDataset,
    pieces: Mapping[Path, EpisodeSplit],
    options: SplitOptions | None,
    copy_options: CopyOptions | None = None,
) -> list[CopyResult]:
    """Write the datasets of a split; ``pieces`` has the episodes of each dataset by output folder.

    ``options``: how validation episodes were chosen; None: episodes keep the split of the source.
    """
    members: dict[Path, list[CopiedEpisode]] = {}
    for out, (train, val) in pieces.items():
        if not train and not val:
            raise DatasetError("this dataset would have no episodes", where=out, fix="Choose other fractions.")
        validation = set(val)
        members[out] = [
            CopiedEpisode(source, number, "val" if number in validation else "train")
            for number in sorted([*train, *val])
        ]
    return copy_episodes(members, options.rule if options else KEEP_RULE, copy_options or CopyOptions())


def _split_within(dataset: Dataset, numbers: list[int], options: SplitOptions | None) -> EpisodeSplit:
    if options is not None and len(numbers) > 1:
        groups = group_episodes(dataset, options.group_by)
        fractions = [1 - options.val_fraction, options.val_fraction]
        train, val = divide_episodes({number: groups[number] for number in numbers}, fractions)
        return train, val
    chosen = set(numbers)
    train, val = ([number for number in listed if number in chosen] for listed in dataset.splits)
    return train, val


def _choose_split(dataset: Dataset, options: SplitOptions) -> EpisodeSplit:
    groups = group_episodes(dataset, options.group_by)
    train, val = divide_episodes(groups, [1 - options.val_fraction, options.val_fraction])
    return train, val
