"""Opens a LeRobot dataset; needs no ``lerobot``. What only those made here have is read where it is there."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.records import (
    SCENES,
    SUBGOALS,
    CameraRecord,
    CamerasRecord,
    ConversionRecord,
    InfoRecord,
    episode_columns,
    frame_columns,
    of_our_shapes,
    unknown_numbers,
)
from robocas_ms3.datasets.lerobot.tables import (
    OBJECTS_LIMIT,
    check_columns,
    is_numeric,
    numbers,
    open_table,
    read_columns,
    read_objects,
    read_rows,
    read_texts,
)
from robocas_ms3.datasets.lerobot.video import read_frames
from robocas_ms3.datasets.sources.files import SEE_VALIDATE
from robocas_ms3.datasets.sources.protocol import EpisodeSource, Kind, Side, SourceEpisode
from robocas_ms3.datasets.sources.reader import check_rate
from robocas_ms3.datasets.sources.tolerant import first_line
from robocas_ms3.documents import DocumentError, json_values, load_json
from robocas_ms3.errors import DatasetError
from robocas_ms3.recordings.subgoals import SubGoal
from robocas_ms3.strict import parse


class LeRobotDataset(EpisodeSource):
    """A dataset's folder.

    Raises:
        DatasetError: no LeRobot dataset there, or one of another version.
        MissingExtraError: pyarrow or av is missing.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        schema.require_extra()
        _ = self.info

    @cached_property
    def info(self) -> dict[str, Any]:
        """``meta/info.json``.

        Raises:
            DatasetError: it is missing or damaged, or of another version.
        """
        path = self.root / schema.INFO_FILE
        try:
            found = load_json(path)
        except (OSError, ValueError) as error:
            raise DatasetError("no LeRobot dataset here", where=path, found=type(error).__name__) from error
        version = found.get("codebase_version") if isinstance(found, dict) else None
        if version != schema.CODEBASE_VERSION:
            what = "a LeRobot dataset of another version"
            raise DatasetError(what, where=self.root, expected=schema.CODEBASE_VERSION, found=version)
        parse(InfoRecord, found, DatasetError, where=path)
        return found

    @cached_property
    def settings(self) -> dict[str, Any]:
        """``meta/robocas/conversion.json``; empty where there is none.

        Raises:
            DatasetError: it is damaged.
        """
        path = self.root / schema.CONVERSION_FILE
        try:
            found = load_json(path) if path.exists() else {}
        except (OSError, ValueError) as error:
            raise DatasetError("this JSON is damaged", where=path, found=first_line(error)) from error
        parse(ConversionRecord, found, DatasetError, where=path)
        return found

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
        return of_our_shapes(self.info["features"])

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """What ``meta/episodes`` says of each episode, but statistics.

        Raises:
            DatasetError: a table is damaged, too long, or lacks a column; or two rows are of one episode.
        """
        found = [row for path, table in self.tables_of_episodes() for row in self._checked(path, table).to_pylist()]
        numbers = [row["episode_index"] for row in found]
        if len(set(numbers)) < len(numbers):
            raise DatasetError("two rows of one episode", where=self.root / "meta/episodes")
        frames = sum(row["length"] for row in found)
        if frames > self.info["total_frames"]:
            what, expected = "episodes are longer than the dataset", f"{self.info['total_frames']} frames at most"
            raise DatasetError(what, where=self.root / "meta/episodes", expected=expected, found=frames)
        return found

    def tables_of_episodes(self) -> Iterator[tuple[Path, pa.Table]]:
        """Yield path and table of the files of ``meta/episodes``, without statistics.

        Raises:
            DatasetError: one is damaged, or they have more rows than there are episodes.
        """
        left = self.info["total_episodes"]
        for path in sorted((self.root / "meta/episodes").glob("*/*.parquet")):
            with open_table(path, most_rows=left) as file:
                names = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
                table = read_columns(file, path, names, limit=OBJECTS_LIMIT)
            left -= len(table)
            yield path, table

    def _checked(self, path: Path, table: pa.Table) -> pa.Table:
        check_columns(table, episode_columns(table.column_names, self.info["features"]), path)
        return table

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
        """Numbers of one side, as the conversion divided them; all of another's dataset train.

        Raises:
            DatasetError: the conversion names an episode that is not there.
        """
        if side == "all" or (side == "train" and "train_eps" not in self.settings):
            return self.numbers
        sides = {f"{side}_eps": self.settings.get(f"{side}_eps", [])}
        for key, unknown in unknown_numbers(sides, self.row_of).items():
            where = f"{self.root / schema.CONVERSION_FILE}, {key}"
            raise DatasetError("episodes that are not there", where=where, found=unknown[:5])
        return list(sides[f"{side}_eps"])

    def entry(self, number: int) -> dict[str, Any]:
        """What the conversion said of it."""
        entries = self.settings.get("episodes", [])
        return entries[number] if number < len(entries) else {}

    @cached_property
    def tasks(self) -> list[str]:
        """Instructions, by ``task_index``."""
        return read_texts(self.root / schema.TASKS_FILE, "task_index", self.info["total_tasks"])

    @cached_property
    def subtasks(self) -> list[str]:
        """Texts of sub-goals, by ``subtask_index``."""
        return read_texts(self.root / schema.SUBTASKS_FILE, "subtask_index", self.info["total_frames"])

    def subtask_texts(self, places: NDArray, where: object) -> list[str]:
        """Return the texts of sub-goals by their numbers.

        Raises:
            DatasetError: there is no text of such a number.
        """
        known = len(self.subtasks)
        wrong = places[~((places >= 0) & (places < known) & (places == np.floor(places)))]
        if len(wrong):
            what, expected = "no such sub-goal", f"0 to {known - 1}"
            raise DatasetError(what, where=f"{where}, subtask_index", expected=expected, found=wrong[0])
        return [self.subtasks[place] for place in places.astype(np.int64).tolist()]

    @cached_property
    def goals(self) -> dict[int, list[SubGoal]]:
        """Number -> sub-goals over the steps, in one pass over the tables; empty where they are not ours.

        Raises:
            DatasetError: one is damaged.
        """
        goals: dict[int, list[SubGoal]] = {}
        left = self.info["total_frames"]
        for path in sorted((self.root / "data").glob("*/*.parquet")) if self.is_ours else ():
            columns = read_objects(path, SUBGOALS, most_rows=left)
            left -= len(columns)
            numbers, kinds, places = (columns.column(key) for key in SUBGOALS)
            texts = self.subtask_texts(places.to_numpy(), path)
            for (number, kind, text), steps in groupby(zip(numbers.to_pylist(), kinds.to_pylist(), texts, strict=True)):
                before = goals.setdefault(number, [])
                first = before[-1].last + 1 if before else 0
                before.append(SubGoal(kind, text, first, first + len(list(steps)) - 1))
        return goals

    @cached_property
    def described(self) -> dict[int, dict[str, str]]:
        """Number -> ``scene`` and ``cameras``, JSON, by ``meta/robocas/episodes.parquet``; empty without.

        Raises:
            DatasetError: the table is damaged.
        """
        path = self.root / schema.SCENES_FILE
        rows = read_objects(path, SCENES, most_rows=self.info["total_episodes"]).to_pylist() if path.exists() else []
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
        """Its rows of the data.

        Raises:
            DatasetError: the file is damaged, or has another number of rows of this episode.
        """
        row = self.row
        path = schema.data_file(
            self.dataset.root, schema.DATA_PATH, row["data/chunk_index"], row["data/file_index"]
        )  # fmt: skip
        table = read_rows(path, self.number, self.dataset.info["total_frames"])
        if len(table) != self.steps:
            what = "another number of rows than the table of episodes says"
            raise DatasetError(what, where=self.where, expected=self.steps, found=len(table))
        return table

    @cached_property
    def columns(self) -> dict[str, NDArray]:
        """Numeric features, (T, D)."""
        table = self.table
        return {name: numbers(table.column(name)) for name in table.column_names if is_numeric(table.field(name).type)}

    @cached_property
    def arrays(self) -> dict[str, NDArray]:
        """Arrays of ``episode_info.npz`` but the embeddings, by the schema's keys.

        Raises:
            DatasetError: the dataset has other columns than those written here, or they are damaged.
        """
        if not self.dataset.is_ours:
            raise DatasetError("not of our columns", where=self.where, expected=", ".join(schema.OUR_KEYS))
        check_columns(self.table, frame_columns(self.dataset.info["features"]), Path(self.where))
        for feature in schema.FEATURES:
            values = self.columns[feature.key]
            if values.shape[1] != feature.width or not (np.abs(values) <= np.finfo(np.float32).max).all():
                where, expected = f"{self.where}, {feature.key}", f"{feature.width} finite numbers per step"
                raise DatasetError("wrong numbers", where=where, expected=expected, fix=SEE_VALIDATE)
        texts = self.dataset.subtask_texts(self.columns[schema.SUBTASK_INDEX.key][:, 0], self.where)
        types = self.table.column(schema.SUBGOAL_TYPE.key).to_pylist()
        try:
            return schema.robocas_arrays(self.columns, self.instruction, texts, types)
        except ValueError as error:  # a quaternion of length 0, a text that is not ASCII
            raise DatasetError("wrong values", where=self.where, found=first_line(error), fix=SEE_VALIDATE) from error

    @property
    def goals(self) -> list[SubGoal]:
        """Sub-goals over the steps; none where the dataset is not one of ours."""
        return self.dataset.goals.get(self.number, [])

    def _described(self, key: str, otherwise: str) -> dict[str, Any]:
        where = f"{self.where}, {schema.SCENES_FILE}, {key}"
        try:
            found = json_values(self.dataset.described.get(self.number, {}).get(key, otherwise))
        except DocumentError as error:
            raise DatasetError("this JSON is damaged", where=where, found=error) from error
        if not isinstance(found, dict):
            raise DatasetError("this JSON is damaged", where=where, expected="an object", found=type(found).__name__)
        return found

    @cached_property
    def scene(self) -> dict[str, Any]:
        """``scene.json``; empty where there is none."""
        return self._described("scene", "{}")

    @cached_property
    def _cameras(self) -> dict[str, CameraRecord]:
        found = {"cameras": self._described("cameras", "{}")}
        return parse(CamerasRecord, found, DatasetError, where=f"{self.where}, {schema.SCENES_FILE}").cameras

    def _camera(self, name: str) -> CameraRecord:
        if name not in self._cameras:
            raise DatasetError("no calibration of this camera", where=self.where, found=name)
        return self._cameras[name]

    def intrinsic(self, camera: str) -> NDArray[np.float64]:
        """(4,) fx, fy, cx, cy in pixels."""
        return np.array(self._camera(camera).intrinsic)

    def camera_in_parent(self, camera: str) -> NDArray[np.float64]:
        """(4, 4) OpenCV camera frame in its parent."""
        return np.array(self._camera(camera).camera_in_parent)

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


def open_lerobot(root: Path, *, rate_hz: float | None = None, include_failed: bool = False) -> LeRobotDataset:
    """Open a dataset; failed episodes are in it where it was made so.

    Raises:
        DatasetError: there is none, or it is of another version or rate.
        MissingExtraError: pyarrow or av is missing.
    """
    dataset = LeRobotDataset(root)
    check_rate(dataset, rate_hz)
    return dataset
