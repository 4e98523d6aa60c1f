"""A dataset that others are made of: finished, of this schema version, with a ledger."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.strict import parse
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.records import ConversionRecord
from robocas_ms3.datasets.sources.tolerant import arrays_fingerprint

Sides = tuple[list[int], list[int]]
"""Training and validation episodes."""


@dataclass(frozen=True)
class Part:
    """A dataset and what it says of itself.

    Attributes:
        dataset: it.
        ledger: number -> entry of ``conversion.json``.
        sides: its split.
    """

    dataset: Dataset
    ledger: Mapping[int, dict[str, Any]]
    sides: Sides

    @property
    def root(self) -> Path:
        """Its folder."""
        return self.dataset.root

    @cached_property
    def settings(self) -> dict[str, Any]:
        """``conversion.json``."""
        return self.dataset.settings

    def identity(self, number: int) -> str:
        """What tells an episode from others: its recording's fingerprint, that of its arrays where it has none."""
        mark = self.ledger[number].get("recording")
        return mark or f"arrays {arrays_fingerprint(self.dataset.episode(number).arrays)}"


def schema_version(dataset: Dataset) -> object:
    """Version of a dataset's schema: 0 is upstream's."""
    return dataset.settings.get("schema_version", 1) if dataset.settings else 0


def open_part(root: Path) -> Part:
    """Open a dataset to make others of.

    Raises:
        DatasetError: there is none, it is of another version, unfinished, or contradicts itself.
    """
    dataset = Dataset(root)
    schema.check_version(schema_version(dataset), root)
    check_whole(dataset)
    parse(ConversionRecord, dataset.settings, DatasetError, where=root / schema.CONVERSION_FILE)
    ledger = {int(number): entry for number, entry in dataset.settings.get("episodes", {}).items()}
    unlisted = [number for number in dataset.numbers if number not in ledger]
    if unlisted:
        where = root / schema.CONVERSION_FILE
        raise DatasetError("these episodes are not listed", where=where, found=shown(unlisted))
    for number in dataset.numbers:
        file = root / schema.episode_folder(number) / schema.SCENE_FILE
        schema.check_version(dataset.episode(number).scene.get("schema_version", 1), file, "an episode")
    return Part(dataset, ledger, dataset.sides)


def check_whole(dataset: Dataset) -> None:
    """Check that ``data_info.json`` lists the episodes on disk: an unfinished conversion's does not.

    Raises:
        DatasetError: it lists others, or something else.
    """
    path = dataset.root / schema.DATA_INFO_FILE
    if not dataset.info:
        raise DatasetError(
            "this dataset is not finished", where=path, found="no file", fix="Run the same robocas convert again first."
        )
    listed = [number for side in dataset.sides for number in side]
    if sorted(listed) != dataset.numbers:
        different = sorted(set(listed) ^ set(dataset.numbers))
        raise DatasetError(
            "not the episodes on disk",
            where=path,
            found=f"{shown(different)} missing, twice, or not on disk",
            fix="Finish it with robocas convert, or accept what is there with robocas split --in-place.",
        )


def shown(values: Iterable[object], most: int = 8) -> str:
    """A few of many, for messages."""
    values = [str(value) for value in values]
    return ", ".join(values[:most]) + (f" and {len(values) - most} more" if len(values) > most else "")


def names_of(roots: Iterable[Path]) -> list[str]:
    """Names that tell datasets apart, as short as they can be: the last parts of their paths."""
    parts = [root.resolve().parts for root in roots]
    for length in range(1, max(map(len, parts), default=1) + 1):
        names = [str(Path(*path[-length:])) for path in parts]
        if len(set(names)) == len(names):
            return names
    return [str(Path(*path)) for path in parts]
