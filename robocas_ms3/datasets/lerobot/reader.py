"""Opens a LeRobot dataset; needs no ``lerobot``. What only those made here have is read where it is there."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.tables import numbers, read_rows, read_texts
from robocas_ms3.datasets.lerobot.video import read_frames
from robocas_ms3.datasets.sources.protocol import EpisodeSource, Kind, Side, SourceEpisode
from robocas_ms3.datasets.sources.reader import check_rate
from robocas_ms3.datasets.sources.tolerant import first_line
from robocas_ms3.documents import json_values, load_json
from robocas_ms3.errors import DatasetError
from robocas_ms3.recordings.subgoals import SubGoal, subgoal_runs


class LeRobotDataset(EpisodeSource):
    """A dataset's folder.

    Raises:
        DatasetError: no LeRobot dataset there, or one of another version.
        MissingExtraError: pyarrow or av is missing.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        schema.require_extra()
        version = self.info.get("codebase_version")
        if version != schema.CODEBASE_VERSION:
            raise DatasetError(
                "a LeRobot dataset of another version", where=self.root, expected=schema.CODEBASE_VERSION, found=version
            )

    @cached_property
    def info(self) -> dict[str, Any]:
        """``meta/info.json``."""
        path = self.root / schema.INFO_FILE
        try:
            return load_json(path)
        except (OSError, ValueError) as error:
            raise DatasetError("no LeRobot dataset here", where=path, found=type(error).__name__) from error

    @cached_property
    def settings(self) -> dict[str, Any]:
        """``meta/robocas/conversion.json``; empty where there is none."""
        path = self.root / schema.CONVERSION_FILE
        try:
            return load_json(path) if path.is_file() else {}
        except (OSError, ValueError) as error:
            raise DatasetError("this JSON is damaged", where=path, found=first_line(error)) from error

    @property
    def rate_hz(self) -> float:
        """Steps a second."""
        return float(self.info["fps"])

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(schema.camera_of(key) for key, ft in self.info["features"].items() if ft["dtype"] == "video")

    @property
    def has_depth(self) -> bool:
        """Whether depth is there."""
        return bool(self.rows) and any(f"depth/{camera}/file_index" in self.rows[0] for camera in self.cameras[:1])

    @property
    def is_ours(self) -> bool:
        """Whether it has the columns of those written here."""
        return set(schema.OUR_KEYS) <= set(self.info["features"])

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """What ``meta/episodes`` says of each episode, but statistics."""
        found: list[dict[str, Any]] = []
        for path in sorted((self.root / "meta/episodes").glob("*/*.parquet")):
            with pq.ParquetFile(path) as file:
                names = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
                found += file.read(columns=names).to_pylist()
        return found

    @cached_property
    def row_of(self) -> dict[int, dict[str, Any]]:
        """The same by number, whichever are there."""
        return {row["episode_index"]: row for row in self.rows}

    @cached_property
    def numbers(self) -> list[int]:
        """Numbers of the episodes."""
        return [row["episode_index"] for row in self.rows]

    @cached_property
    def lengths(self) -> dict[int, int]:
        """Number -> T."""
        return {row["episode_index"]: int(row["length"]) for row in self.rows}

    def split(self, side: Side) -> list[int]:
        """Numbers of one side, as the conversion divided them; all of another's dataset train."""
        if side == "all" or (side == "train" and "train_eps" not in self.settings):
            return self.numbers
        return list(self.settings.get(f"{side}_eps", []))

    def entry(self, number: int) -> dict[str, Any]:
        """What the conversion said of it."""
        entries = self.settings.get("episodes", [])
        return entries[number] if number < len(entries) else {}

    @cached_property
    def tasks(self) -> list[str]:
        """Instructions, by ``task_index``."""
        return read_texts(self.root / schema.TASKS_FILE)

    @cached_property
    def subtasks(self) -> list[str]:
        """Texts of sub-goals, by ``subtask_index``."""
        return read_texts(self.root / schema.SUBTASKS_FILE)

    @cached_property
    def goals(self) -> dict[int, list[SubGoal]]:
        """Number -> sub-goals over the steps, in one pass over the tables; empty where they are not ours.

        Raises:
            DatasetError: one is damaged.
        """
        steps: dict[int, list[tuple[str, str]]] = {}
        keys = ["episode_index", schema.SUBGOAL_TYPE.key, schema.SUBTASK_INDEX.key]
        for path in sorted((self.root / "data").glob("*/*.parquet")) if self.is_ours else ():
            with _readable(path):
                columns = pq.read_table(path, columns=keys)
                for number, kind, text in zip(*(columns.column(key).to_pylist() for key in keys), strict=True):
                    steps.setdefault(number, []).append((kind, self.subtasks[text]))
        return {number: subgoal_runs(*zip(*found, strict=True)) for number, found in steps.items()}

    @cached_property
    def described(self) -> dict[int, dict[str, str]]:
        """Number -> ``scene`` and ``cameras``, JSON, by ``meta/robocas/episodes.parquet``; empty without."""
        path = self.root / schema.SCENES_FILE
        rows = pq.read_table(path).to_pylist() if path.is_file() else []
        return {row.pop("episode_index"): row for row in rows}

    def episode(self, number: int) -> LeRobotEpisode:
        """Open an episode.

        Raises:
            DatasetError: there is none of this number.
        """
        if number not in self.row_of:
            raise DatasetError("no such episode", where=self.root, expected=f"0 to {len(self.rows) - 1}", found=number)
        return LeRobotEpisode(self, number)


@dataclass(frozen=True)
class LeRobotEpisode(SourceEpisode):
    """One of its episodes."""

    dataset: LeRobotDataset
    number: int

    @property
    def where(self) -> str:
        """Dataset and number."""
        return f"{self.dataset.root}, episode {self.number}"

    @property
    def row(self) -> dict[str, Any]:
        """What ``meta/episodes`` says of it."""
        return self.dataset.row_of[self.number]

    @property
    def steps(self) -> int:
        """T."""
        return int(self.row["length"])

    @property
    def instruction(self) -> str:
        """The first of its tasks; empty where it has none."""
        return str((self.row.get("tasks") or [""])[0])

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return self.dataset.cameras

    @property
    def has_depth(self) -> bool:
        """Whether depth is there."""
        return self.dataset.has_depth

    @cached_property
    def table(self) -> pa.Table:
        """Its rows of the data."""
        row = self.row
        path = schema.data_file(
            self.dataset.root, schema.DATA_PATH, row["data/chunk_index"], row["data/file_index"]
        )  # fmt: skip
        with _readable(path):
            return read_rows(path, self.number)

    @cached_property
    def columns(self) -> dict[str, NDArray]:
        """Numeric features, (T, D)."""
        table = self.table
        return {name: numbers(table.column(name)) for name in table.column_names if name != schema.SUBGOAL_TYPE.key}

    @cached_property
    def arrays(self) -> dict[str, NDArray]:
        """Arrays of ``episode_info.npz`` but the embeddings, by the schema's keys.

        Raises:
            DatasetError: the dataset has other columns than those written here.
        """
        if not self.dataset.is_ours:
            raise DatasetError("not of our columns", where=self.where, expected=", ".join(schema.OUR_KEYS))
        texts = [self.dataset.subtasks[i] for i in self.columns[schema.SUBTASK_INDEX.key][:, 0]]
        types = self.table.column(schema.SUBGOAL_TYPE.key).to_pylist()
        return schema.robocas_arrays(self.columns, self.row["tasks"][0], texts, types)

    @property
    def goals(self) -> list[SubGoal]:
        """Sub-goals over the steps; none where the dataset is not one of ours."""
        return self.dataset.goals.get(self.number, [])

    @cached_property
    def _ours(self) -> dict[str, Any]:
        return {key: json_values(value) for key, value in self.dataset.described.get(self.number, {}).items()}

    @property
    def scene(self) -> dict[str, Any]:
        """``scene.json``; empty where there is none."""
        return self._ours.get("scene", {})

    def intrinsic(self, camera: str) -> NDArray[np.float64]:
        """(4,) fx, fy, cx, cy in pixels."""
        return np.array(self._ours["cameras"][camera]["intrinsic"])

    def camera_in_parent(self, camera: str) -> NDArray[np.float64]:
        """(4, 4) OpenCV camera frame in its parent."""
        return np.array(self._ours["cameras"][camera]["camera_in_parent"])

    def video(self, camera: str, kind: Kind) -> tuple[Path, int]:
        """File of a camera's video and the number of its first frame there."""
        names = {"video_key": schema.image_key(camera), "camera": camera}
        start = f"videos/{names['video_key']}" if kind == "rgb" else f"depth/{camera}"
        pattern = schema.VIDEO_PATH if kind == "rgb" else schema.DEPTH_PATH
        row = self.row
        path = schema.data_file(
            self.dataset.root, pattern, row[f"{start}/chunk_index"], row[f"{start}/file_index"], **names
        )  # fmt: skip
        return path, round(row[f"{start}/from_timestamp"] * self.dataset.info["fps"])

    def frames(
        self, camera: str, kind: Kind = "rgb", first: int = 0, count: int | None = None
    ) -> Generator[NDArray, None, None]:
        """Pictures one after the other, for which their video is opened once."""
        path, start = self.video(camera, kind)
        count = self.steps - first if count is None else count
        return read_frames(path, start + first, count, self.dataset.info["fps"])

    def rgb(self, camera: str, step: int) -> NDArray[np.uint8]:
        """(H, W, 3) RGB."""
        (picture,) = self.frames(camera, "rgb", step, 1)
        return picture

    def depth(self, camera: str, step: int) -> NDArray[np.uint16]:
        """(H, W) mm, 0 = nothing."""
        (picture,) = self.frames(camera, "depth", step, 1)
        return picture


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, pa.ArrowException, LookupError) as error:
        fix = "robocas validate says what is wrong."
        raise DatasetError("this table can't be read", where=path, found=first_line(error), fix=fix) from error


def open_lerobot(root: Path, *, rate_hz: float | None = None, include_failed: bool = False) -> LeRobotDataset:
    """Open a dataset; failed episodes are in it where it was made so.

    Raises:
        DatasetError: there is none, or it is of another version or rate.
        MissingExtraError: pyarrow or av is missing.
    """
    dataset = LeRobotDataset(root)
    check_rate(dataset, rate_hz)
    return dataset
