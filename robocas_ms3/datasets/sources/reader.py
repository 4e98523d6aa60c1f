"""Opens a RoboCAS folder: its overviews, and its episodes by number."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.episode import DEFAULT_RATE, Episode
from robocas_ms3.datasets.sources.files import no_dataset, read_json
from robocas_ms3.datasets.sources.protocol import EpisodeSource, Side

_SPLIT = "robocas split --in-place --val-share 0.1 makes a new one."


class Dataset(EpisodeSource):
    """A dataset's folder.

    Raises:
        DatasetError: no episodes there.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        if next(self._found(), None) is None:
            raise no_dataset(self.root, "folders episode_0000000, ...")

    def _found(self) -> Iterator[int]:
        if not self.root.is_dir():
            return
        with os.scandir(self.root) as entries:  # which tells folders without asking for each
            for entry in entries:
                number = schema.episode_number(entry.name)
                if number is not None and entry.is_dir():
                    yield number

    @cached_property
    def numbers(self) -> list[int]:
        """Numbers of the episodes on disk."""
        return sorted(self._found())

    @cached_property
    def _known(self) -> frozenset[int]:
        return frozenset(self.numbers)

    @cached_property
    def settings(self) -> dict[str, Any]:
        """``conversion.json``; empty where there is none."""
        return read_json(self.root / schema.CONVERSION_FILE)

    @cached_property
    def info(self) -> dict[str, Any]:
        """``data_info.json``; empty where there is none."""
        return read_json(self.root / schema.DATA_INFO_FILE)

    @cached_property
    def sides(self) -> tuple[list[int], list[int]]:
        """Training and validation episodes, as ``data_info.json`` lists them; numbers written as texts count too.

        Raises:
            DatasetError: a list holds something else.
        """
        return self._side("train_eps"), self._side("val_eps")

    def _side(self, key: str) -> list[int]:
        listed = self.info.get(key, [])
        if isinstance(listed, list) and all(type(n) is int or (isinstance(n, str) and n.isdecimal()) for n in listed):
            return [int(n) for n in listed]
        where = f"{self.root / schema.DATA_INFO_FILE}, {key}"
        found = str(listed)[:60]
        raise DatasetError("this split is damaged", where=where, expected="episode numbers", found=found, fix=_SPLIT)

    @cached_property
    def rate_hz(self) -> float:
        """Steps a second: from ``conversion.json``, 5 where there is none.

        Raises:
            DatasetError: it says something else.
        """
        said = self.settings.get("rate_hz", DEFAULT_RATE)
        if isinstance(said, int | float) and 0 < said < np.inf:
            return float(said)
        raise self._damaged_settings(f"rate_hz {said!r}")

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras: by ``conversion.json``, else those of the first episode.

        Raises:
            DatasetError: it says something else.
        """
        said = self.settings.get("cameras", self._first.cameras)
        if isinstance(said, list | tuple) and all(isinstance(name, str) for name in said):
            return tuple(said)
        raise self._damaged_settings(f"cameras {said!r}")

    @property
    def has_depth(self) -> bool:
        """Whether depth is there."""
        return bool(self.settings.get("depth", self._first.has_depth))

    @property
    def has_embeddings(self) -> bool:
        """Whether embeddings are there, as far as ``conversion.json`` says."""
        return bool(self.settings.get("embeddings", True))

    @property
    def _first(self) -> Episode:
        return Episode(self.root / schema.episode_folder(self.numbers[0]))

    def _damaged_settings(self, found: str) -> DatasetError:
        where, expected = self.root / schema.CONVERSION_FILE, "rate_hz > 0, a list of cameras"
        fix = "robocas validate says what is wrong."
        return DatasetError("these settings are damaged", where=where, expected=expected, found=found[:80], fix=fix)

    @cached_property
    def lengths(self) -> dict[int, int]:
        """Number -> T, by ``data_info.json``.

        Raises:
            DatasetError: there is none, or it is damaged.
        """
        where = self.root / schema.DATA_INFO_FILE
        if not self.info:
            if self.settings:
                raise DatasetError("this dataset is not finished", where=self.root, fix="Convert with --resume.")
            raise no_dataset(self.root, f"a folder with {schema.DATA_INFO_FILE}, or a trajectory.h5")
        try:
            missing = [key for key in ("ep_length", "train_eps", "val_eps") if key not in self.info]
            if missing:
                raise KeyError(*missing)
            return {int(number): int(length) for number, length in self.info["ep_length"].items()}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DatasetError(
                "this overview is damaged",
                where=where,
                expected="ep_length, train_eps, val_eps",
                found=f"{type(error).__name__}: {error}",
                fix="robocas validate says what is wrong.",
            ) from error

    def split(self, side: Side) -> list[int]:
        """Numbers of the episodes of one side, by ``data_info.json``.

        Raises:
            DatasetError: it gives no length for one of them, or is damaged.
        """
        numbers = sorted(self.lengths) if side == "all" else self.sides[side == "val"]
        unknown = [number for number in numbers if number not in self.lengths]
        if unknown:
            raise DatasetError("episodes of unknown length", where=self.root / schema.DATA_INFO_FILE, found=unknown[:5])
        return numbers

    def entry(self, number: int) -> dict[str, Any]:
        """What ``conversion.json`` says of an episode."""
        entries = self.settings.get("episodes")
        found = entries.get(str(number)) if isinstance(entries, dict) else None
        return found if isinstance(found, dict) else {}

    def action_space(self) -> dict[str, Any]:
        """As ``data_info.json`` has it."""
        return self.info.get("action_space", {})

    def episode(self, number: int) -> Episode:
        """Open an episode.

        Raises:
            DatasetError: there is none of this number.
        """
        if number not in self._known:
            known = f"{self.numbers[0]} to {self.numbers[-1]}"
            raise DatasetError("no such episode", where=self.root, expected=known, found=number)
        return Episode(self.root / schema.episode_folder(number), self)


def open_folder(path: Path, *, rate_hz: float | None = None, include_failed: bool = False) -> Dataset:
    """Open a folder; failed episodes are in it where it was made so.

    Raises:
        DatasetError: there is none, or it is of another rate.
    """
    dataset = Dataset(path)
    check_rate(dataset, rate_hz)
    return dataset


def check_rate(source: EpisodeSource, rate_hz: float | None) -> None:
    """Refuse another rate than a dataset's.

    Raises:
        DatasetError: it is asked for.
    """
    if rate_hz is not None and rate_hz != source.rate_hz:
        raise DatasetError(
            "the dataset has another rate",
            where=source.root,
            expected=f"{source.rate_hz:g} Hz",
            found=f"{rate_hz:g}",
            fix="Convert the trajectory again with this --rate.",
        )
