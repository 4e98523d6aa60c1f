"""Makes a dataset of episodes of others: merging and splitting."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import robocas_ms3
from robocas_ms3.core.files import replacing_folder
from robocas_ms3.core.outputs import OutputFolder
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.manage.input_check import check_episodes
from robocas_ms3.datasets.manage.parts import Part
from robocas_ms3.datasets.writing.info import write_info
from robocas_ms3.datasets.writing.output import DATASET, Placer, check_apart, dataset_output, settings_of
from robocas_ms3.datasets.writing.plan import SETTINGS

Side = Literal["train", "val"]
OnStart = Callable[[int], None]
OnEpisode = Callable[[int], None]


@dataclass(frozen=True)
class Member:
    """An episode that will be in the new dataset.

    Attributes:
        part: the dataset it is in.
        name: of that dataset, for the ledger.
        number: of the episode in it.
        side: of the split it will be on.
    """

    part: Part
    name: str
    number: int
    side: Side


@dataclass(frozen=True)
class Assembly:
    """What was done: episodes, how many of them were there already, files linked and copied."""

    out: Path
    episodes: int
    kept: int
    linked: int
    copied: int

    def __str__(self) -> str:
        """One line."""
        kept = f", {self.kept} of them were there" if self.kept else ""
        linked = f"{count_of(self.linked, 'file')} linked, {self.copied} copied"
        return f"{self.out}: {count_of(self.episodes, 'episode')}{kept}, {linked}"


def check_before(outs: Mapping[Path, Sequence[Member]], split_rule: str, *, overwrite: bool) -> None:
    """Refuse outputs that can't be written and episodes that are damaged, before anything is written.

    Args:
        outs: folder -> its episodes.
        split_rule, overwrite: see `assemble`.

    Raises:
        DatasetError: an output is an input, or an episode is damaged.
        OutputExistsError: an output is another dataset, or none.
    """
    numbers: dict[Path, tuple[Part, list[int]]] = {}
    for member in (member for members in outs.values() for member in members):
        numbers.setdefault(member.part.root, (member.part, []))[1].append(member.number)
    for out, members in outs.items():
        check_apart(out, list(numbers))
        OutputFolder(out, DATASET, settings_of(_record(members, split_rule)), overwrite=overwrite).read()
    for part, chosen in numbers.values():
        check_episodes(part, chosen)


def assemble(
    out: Path,
    members: Sequence[Member],
    *,
    split_rule: str,
    link: bool = True,
    overwrite: bool = False,
    on_start: OnStart | None = None,
    on_episode: OnEpisode | None = None,
) -> Assembly:
    """Write a dataset of these episodes, in this order, numbered from 0; `check_before` has seen them.

    Called again after a kill at any moment, it continues, with the same result. Hard links share the files with
    the datasets they are from: nothing in this package changes a file in place, an editor may.

    Args:
        out: its folder.
        members: at least one; all of the same settings.
        split_rule: how their sides were chosen, for ``conversion.json``.
        link: hard links where the file system allows; else copies.
        overwrite: start again, and replace a dataset that exists.
        on_start: called with the number of episodes to write.
        on_episode: called with the number of each, when it is there.

    Raises:
        DatasetError: the output is an input.
        OutputExistsError: ``out`` is another dataset, or none.
    """
    inputs = list(dict.fromkeys(member.part.root for member in members))
    with dataset_output(out, _record(members, split_rule), inputs=inputs, overwrite=overwrite):
        placer = Placer(link)
        missing = [n for n in range(len(members)) if not (out / schema.episode_folder(n)).is_dir()]
        if on_start:
            on_start(len(missing))
        for number in missing:
            member = members[number]
            with replacing_folder(out / schema.episode_folder(number)) as folder:
                placer.tree(member.part.root / schema.episode_folder(member.number), folder)
            if on_episode:
                on_episode(number)
        sides = [[n for n, member in enumerate(members) if member.side == side] for side in ("train", "val")]
        write_info(out, (sides[0], sides[1]))
    return Assembly(out, len(members), len(members) - len(missing), placer.linked, placer.copied)


def _record(members: Sequence[Member], split_rule: str) -> dict[str, Any]:
    settings = members[0].part.settings
    return {
        "format": "robocas",
        "schema_version": schema.SCHEMA_VERSION,
        "made_with": {"robocas_ms3": robocas_ms3.__version__},
        **{key: settings[key] for key in SETTINGS},
        "split": split_rule,
        "episodes": {str(number): _entry(member) for number, member in enumerate(members)},
    }


def _entry(member: Member) -> dict[str, Any]:
    entry = dict(member.part.ledger[member.number])
    source = {"dataset": member.name, "episode": member.number}
    if "from" in entry:
        source["from"] = entry["from"]  # it had been moved before
    return {**entry, "from": source}
