"""One dataset as several, or its split into training and validation anew."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import write_json
from robocas_ms3.core.locks import locked_folder
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.manage.assemble import Assembly, Member, OnEpisode, OnStart, Side, assemble, check_before
from robocas_ms3.datasets.manage.input_check import check_numbers
from robocas_ms3.datasets.manage.parts import Part, Sides, names_of
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.writing.info import info_of

By = Literal["seed", "target", "task"]
KEEP_RULE = "every episode keeps the side it had in the dataset it is from"


@dataclass(frozen=True)
class Share:
    """How training and validation are chosen.

    Attributes:
        val: share of the episodes that validate, between 0 and 1.
        by: what stays on one side: episodes of one seed, target object or task.
    """

    val: float
    by: By = "seed"

    def __post_init__(self) -> None:
        """Check the share.

        Raises:
            DatasetError: it is none.
        """
        if not 0 < self.val < 1:
            raise DatasetError("not a share", where="val_share", expected="> 0 and < 1", found=self.val)

    @property
    def rule(self) -> str:
        """In words, for ``conversion.json``."""
        return f"{self.by}s in the order of sha256({self.by}), the first {self.val:g} of the episodes validate"


def groups_of(dataset: Dataset, by: By) -> dict[int, str]:
    """Episode number -> its seed, target object or task, as text.

    Raises:
        DatasetError: an episode does not say it.
    """
    groups = {}
    for number in dataset.numbers:
        scene = dataset.episode(number).scene
        target = scene.get("target") or {}
        value = {"seed": scene.get("seed"), "target": target.get("asset_id"), "task": scene.get("task")}[by]
        if value is None and by == "seed":
            value = number  # an unknown seed is one of its own, as in `info.summarize`
        if value is None:
            raise DatasetError(
                f"this episode does not say its {by}",
                where=dataset.root / schema.episode_folder(number) / schema.SCENE_FILE,
                fix="Choose another --by, or convert the episode's recording again.",
            )
        groups[number] = str(value)
    return groups


def cut(groups: Mapping[int, str], shares: Sequence[float], salt: str = "") -> list[list[int]]:
    """Cut episodes into parts of about these shares; a group is never cut.

    Groups come in the order of their SHA-256, and fill the last part first: a group's place depends on the groups
    alone. Each part gets a group as long as there are some.

    Args:
        groups: episode number -> its group.
        shares: of each part; they sum to 1.
        salt: before a group's name; another one gives an order that has nothing to do with this one.

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
    """Rewrite ``data_info.json`` from the episodes on disk; no episode is touched. Gives the sides.

    ``conversion.json`` forgets episodes that are not there any more.

    Args:
        root: the dataset.
        share: how to split; None: every episode keeps its side, new ones are split by the writer's rule.

    Raises:
        DatasetError: there is no dataset, it can't be split so, or arrays of an episode are damaged.
    """
    with locked_folder(root):
        dataset = Dataset(root)
        sides = dataset.sides if share is None else _sides(dataset, share)
        check_numbers(dataset)
        info = info_of(root, sides)
        settings = dataset.settings
        if settings:
            there = {str(number) for number in dataset.numbers}
            kept = {number: entry for number, entry in settings.get("episodes", {}).items() if number in there}
            rule = {} if share is None else {"split": share.rule}
            new = {**settings, **rule, **({"episodes": kept} if "episodes" in settings else {})}
            if new != settings:
                write_json(root / schema.CONVERSION_FILE, new)
        write_json(root / schema.DATA_INFO_FILE, info)
    return info["train_eps"], info["val_eps"]


def parts_by_side(part: Part, share: Share | None, train: Path, val: Path) -> dict[Path, Sides]:
    """Training and validation as two datasets: output -> sides of its episodes.

    Raises:
        DatasetError: both would be one folder, or one in the other.
    """
    a, b = train.resolve(), val.resolve()
    if a == b or a in b.parents or b in a.parents:
        raise DatasetError("two datasets in one folder", where=val, fix="Choose two that are apart.")
    sides = part.sides if share is None else _sides(part.dataset, share)
    return {train: (sides[0], []), val: ([], sides[1])}


def parts_by_share(part: Part, shares: Sequence[float], by: By, share: Share | None, out: Path) -> dict[Path, Sides]:
    """Datasets ``out/part_0``, ... of these shares."""
    # In an order of its own: in that of the sides, the last part would get all that validates.
    pieces = cut(groups_of(part.dataset, by), shares, salt="part ")
    return {out / f"part_{index}": _within(part, piece, share) for index, piece in enumerate(pieces)}


def parts_by_value(part: Part, by: By, share: Share | None, out: Path) -> dict[Path, Sides]:
    """A dataset ``out/<value>`` for each task or target object."""
    groups = groups_of(part.dataset, by)
    pieces = {value: [n for n, group in groups.items() if group == value] for value in sorted(set(groups.values()))}
    names = folder_names(pieces)
    return {out / names[value]: _within(part, piece, share) for value, piece in pieces.items()}


def folder_names(values: Iterable[str]) -> dict[str, str]:
    """Names of folders for values, whatever a dataset says; no two have the same."""
    plain = {value: re.sub(r"[^\w.-]+", "_", value).strip(".")[:40] or "_" for value in values}
    shared = Counter(plain.values())
    return {
        value: name if shared[name] == 1 else f"{name}-{hashlib.sha256(value.encode()).hexdigest()[:8]}"
        for value, name in plain.items()
    }


def write_parts(
    part: Part,
    pieces: Mapping[Path, Sides],
    *,
    share: Share | None,
    link: bool = True,
    overwrite: bool = False,
    on_start: OnStart | None = None,
    on_episode: OnEpisode | None = None,
) -> list[Assembly]:
    """Write the datasets that a split makes.

    Args:
        part: the dataset that is split.
        pieces: output -> training and validation episodes of ``part``.
        share: how the sides were chosen; None: as they were.
        link, overwrite: see `assemble`.
        on_start: called with the number of episodes of all pieces.
        on_episode: called after each.

    Raises:
        DatasetError: an output would be empty, or is the input; an episode is damaged.
        OutputExistsError: an output is another dataset, or none.
    """
    for out, sides in pieces.items():
        if not any(sides):
            raise DatasetError("no episodes for this part", where=out, fix="Choose other shares.")
    name = names_of([part.root])[0]
    members: dict[Path, list[Member]] = {}
    for out, (train, val) in pieces.items():
        side_of: dict[int, Side] = {**dict.fromkeys(train, "train"), **dict.fromkeys(val, "val")}
        members[out] = [Member(part, name, number, side_of[number]) for number in sorted(side_of)]
    rule = share.rule if share else KEEP_RULE
    check_before(members, rule, overwrite=overwrite)
    if on_start:
        on_start(sum(map(len, members.values())))
    write = partial(assemble, split_rule=rule, link=link, overwrite=overwrite, on_episode=on_episode)
    return [write(out, chosen) for out, chosen in members.items()]


def _within(part: Part, numbers: list[int], share: Share | None) -> Sides:
    if share is not None and len(numbers) > 1:
        groups = groups_of(part.dataset, share.by)
        train, val = cut({number: groups[number] for number in numbers}, [1 - share.val, share.val])
        return train, val
    chosen = set(numbers)
    return [n for n in part.sides[0] if n in chosen], [n for n in part.sides[1] if n in chosen]


def _sides(dataset: Dataset, share: Share) -> Sides:
    train, val = cut(groups_of(dataset, share.by), [1 - share.val, share.val])
    return train, val
