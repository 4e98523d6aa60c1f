"""Training samples of a RoboCAS folder."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.reader import Dataset, Episode, no_dataset
from robocas_ms3.datasets.sources.tolerant import DAMAGED, first_line, is_declared
from robocas_ms3.errors import DatasetError
from robocas_ms3.recordings.subgoals import SubGoal, read_subgoals

if TYPE_CHECKING:
    from robocas_ms3.datasets.formats import Split


class FolderSource:
    """A RoboCAS folder. Reads ``data_info.json`` and ``conversion.json``.

    Raises:
        DatasetError: one of them is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        info_file = path / schema.DATA_INFO_FILE
        if not info_file.is_file():
            if (path / schema.CONVERSION_FILE).is_file():
                raise DatasetError("this dataset is not finished", where=path, fix="Convert with --resume.")
            raise no_dataset(path, f"a folder with {schema.DATA_INFO_FILE}, or a trajectory.h5")
        overview = _Overview(path)
        self.info, settings = overview.info, overview.settings
        try:
            self.lengths = {int(number): int(length) for number, length in self.info["ep_length"].items()}
            self._split = {side: [int(n) for n in self.info[f"{side}_eps"]] for side in ("train", "val")}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DatasetError(
                "this overview is damaged",
                where=info_file,
                expected="ep_length, train_eps, val_eps",
                found=f"{type(error).__name__}: {error}",
                fix="robocas validate says what is wrong.",
            ) from error
        first = Episode(path / schema.episode_folder(min(self.lengths, default=0)))  # where there are no settings
        try:
            self.rate_hz = overview.rate_hz
            if not 0 < self.rate_hz < np.inf:
                raise ValueError(f"rate_hz {self.rate_hz}")
            self.cameras = tuple(settings["cameras"]) if "cameras" in settings else first.cameras
        except (TypeError, ValueError) as error:
            raise DatasetError(
                "these settings are damaged",
                where=path / schema.CONVERSION_FILE,
                expected="rate_hz > 0, a list of cameras",
                found=first_line(error),
                fix="robocas validate says what is wrong.",
            ) from error
        self.has_depth = bool(settings["depth"]) if "depth" in settings else first.has_depth
        self.has_embeddings = bool(settings.get("embeddings", True))

    def split(self, side: Split) -> list[int]:
        """Numbers of the episodes of one side.

        Raises:
            DatasetError: ``data_info.json`` gives no length for one of them.
        """
        numbers = sorted(self.lengths) if side == "all" else self._split[side]
        unknown = [number for number in numbers if number not in self.lengths]
        if unknown:
            raise DatasetError("episodes of unknown length", where=self.path / schema.DATA_INFO_FILE, found=unknown[:5])
        return numbers

    def goals(self, number: int) -> list[SubGoal]:
        """Sub-goals of an episode, from ``data_info.json``."""
        entries = self.info.get("step_goals", {}).get(str(number), [])
        return read_subgoals(entries, f"{self.path / schema.DATA_INFO_FILE}, step_goals.{number}")

    def arrays(self, number: int, keys: Sequence[str]) -> dict[str, NDArray]:
        """Read some of an episode's arrays.

        Raises:
            DatasetError: the file or one of them is missing or damaged.
        """
        path = self.path / schema.episode_folder(number) / schema.EPISODE_FILE
        try:
            with np.load(path, allow_pickle=False) as content:
                found = {key: content[key] for key in keys if key in content.files}
            if all(key in found and is_declared(key, found[key]) for key in keys):
                return found
            made = self._dataset.episode(number).arrays  # slower; casts and completes what was made elsewhere
        except (*DAMAGED, KeyError) as error:
            raise DatasetError(
                "this episode can't be read",
                where=path,
                found=getattr(error, "strerror", None) or first_line(error),
                fix="robocas validate says what is wrong.",
            ) from error
        missing = [key for key in keys if key not in made]
        if missing:
            raise DatasetError("arrays are missing", where=path, expected=", ".join(missing))
        return {key: made[key] for key in keys}

    @cached_property
    def _dataset(self) -> Dataset:
        return Dataset(self.path)

    def action_space(self) -> dict[str, Any]:
        """As ``data_info.json`` has it."""
        return self.info.get("action_space", {})

    def episode(self, number: int) -> Episode:
        """An episode's folder, which is not looked at yet."""
        return Episode(self.path / schema.episode_folder(number))


class _Overview(Dataset):
    """A dataset's overview alone: the folder is not listed."""

    def __post_init__(self) -> None:
        """Nothing to check."""
