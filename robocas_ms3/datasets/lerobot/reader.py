"""Reader of LeRobot datasets, without the package ``lerobot``."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.strict_model import parse_json
from robocas_ms3.core.text import one_line
from robocas_ms3.datasets.images.image_files import Box
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.arrays import to_robocas_arrays
from robocas_ms3.datasets.lerobot.file_models import CameraRecord, CamerasRecord, SceneContent, declare_frame_columns
from robocas_ms3.datasets.lerobot.language import EVENTS, PERSISTENT, read_boxes, read_language_rows, read_subgoal_texts
from robocas_ms3.datasets.lerobot.metadata import LeRobotMetadata
from robocas_ms3.datasets.lerobot.tables import INTEGER, Column, check_columns, is_numeric, read_episode_rows, to_array
from robocas_ms3.datasets.lerobot.video import read_frames, to_depth
from robocas_ms3.datasets.sources.episode_source import EpisodeSource, ImageKind, SourceEpisode, Split
from robocas_ms3.datasets.sources.file_models import has_action_noise
from robocas_ms3.datasets.sources.files import SEE_VALIDATE
from robocas_ms3.datasets.sources.reader import check_rate
from robocas_ms3.demos.recordings.subgoals import SubGoal, group_subgoals
from robocas_ms3.robots.cameras import Parent, standard_camera_parent

_RootModel = TypeVar("_RootModel", SceneContent, CamerasRecord)


class LeRobotDataset(LeRobotMetadata, EpisodeSource):
    """LeRobot dataset, read without the package ``lerobot``.

    Only datasets of ``robocas convert`` have arrays, scenes and camera models.

    Raises:
        DatasetError: the folder is not a LeRobot dataset, or has an unsupported version.
        MissingExtraError: the extra ``lerobot`` is not installed.
    """

    @property
    def rate_hz(self) -> float:
        return float(self.info["fps"])

    @cached_property
    def numbers(self) -> list[int]:
        return list(self.row_by_episode)

    @cached_property
    def lengths(self) -> dict[int, int]:
        return {number: int(row["length"]) for number, row in self.row_by_episode.items()}

    def split(self, name: Split) -> list[int]:
        """Return the episode numbers of a split.

        In a dataset without the RoboCAS split, all episodes are training episodes.
        """
        if name == "all" or (name == "train" and "train_eps" not in self.settings):
            return self.numbers
        key = f"{name}_eps"
        listed = self.settings.get(key, [])
        unknown = [number for number in listed if number not in self.row_by_episode]
        if unknown:
            where = f"{self.root / schema.CONVERSION_FILE}, {key}"
            what, expected = "this split lists unknown episodes", f"0 to {len(self.rows) - 1}"
            raise DatasetError(what, where=where, expected=expected, found=unknown[:5])
        return list(listed)

    def conversion_entry(self, number: int) -> dict[str, Any]:
        entries = self.settings.get("episodes", [])
        return entries[number] if number < len(entries) else {}

    def episode(self, number: int) -> LeRobotEpisode:
        if number not in self.row_by_episode:
            expected = f"0 to {len(self.rows) - 1}"
            raise DatasetError("no such episode", where=self.root, expected=expected, found=number, usage=True)
        return LeRobotEpisode(self, number)


@dataclass(frozen=True)
class LeRobotEpisode(SourceEpisode):
    """Episode of a `LeRobotDataset`."""

    dataset: LeRobotDataset
    number: int

    @property
    def where(self) -> str:
        return f"{self.dataset.root}, episode {self.number}"

    @property
    def row(self) -> dict[str, Any]:
        return self.dataset.row_by_episode[self.number]

    @property
    def steps(self) -> int:
        return int(self.row["length"])

    @property
    def instruction(self) -> str:
        """Instruction: the first of LeRobot's tasks of the episode; empty without a task."""
        return str((self.row.get("tasks") or [""])[0])

    @property
    def cameras(self) -> tuple[str, ...]:
        return self.dataset.cameras

    @cached_property
    def frame_table(self) -> pa.Table:
        path = self.dataset.file_layout.episode_path(self.dataset.root, "data", self.row)
        table = read_episode_rows(path, self.number, self.dataset.info["total_frames"])
        if len(table) != self.steps:
            what = "wrong number of rows in the data table"
            raise DatasetError(what, where=self.where, expected=self.steps, found=len(table))
        return table

    @cached_property
    def columns(self) -> dict[str, NDArray]:
        table = self.frame_table
        return {name: to_array(table.column(name)) for name in table.column_names if is_numeric(table.field(name).type)}

    @cached_property
    def arrays(self) -> dict[str, NDArray]:
        if not self.dataset.has_robocas_features:
            raise DatasetError(
                "this dataset lacks the features of robocas convert",
                where=self.where,
                expected=", ".join(schema.ROBOCAS_KEYS),
            )
        types, texts = self._read_subgoals()
        for feature in schema.FEATURES:
            values = self.columns[feature.key]
            if values.shape[1] != feature.width or not (np.abs(values) <= np.finfo(np.float32).max).all():
                where, expected = f"{self.where}, {feature.key}", f"{feature.width} finite numbers per step"
                raise DatasetError("invalid values", where=where, expected=expected, fix=SEE_VALIDATE)
        try:
            return to_robocas_arrays(
                self.columns, self.instruction, texts, types, has_action_noise=has_action_noise(self.scene)
            )
        except ValueError as error:  # a quaternion of length 0, or a text that is not ASCII
            what, found = "no arrays can be computed from these features", one_line(error)
            raise DatasetError(what, where=self.where, found=found, fix=SEE_VALIDATE) from error

    @property
    def goals(self) -> list[SubGoal]:
        """Sub-goals and their steps; empty unless ``robocas convert`` wrote the dataset."""
        return group_subgoals(*self._read_subgoals()) if self.dataset.has_robocas_features else []

    def _read_subgoals(self) -> tuple[list[str], list[str]]:
        key, columns = schema.SUBTASK_INDEX.key, declare_frame_columns(self.dataset.info["features"])
        if not self.dataset.has_language:
            columns[key] = Column(INTEGER, greatest=len(self.dataset.subtasks) - 1)
        check_columns(self.frame_table, columns, Path(self.where))
        types = self.frame_table.column(schema.SUBGOAL_TYPE.key).to_pylist()
        if self.dataset.has_language:
            rows = read_language_rows(self.frame_table.slice(0, 1), PERSISTENT, self.where)[0]
            return types, read_subgoal_texts(rows, self.steps, self.dataset.info["fps"])
        return types, [self.dataset.subtasks[place] for place in self.frame_table.column(key).to_pylist()]

    @cached_property
    def target_boxes(self) -> Sequence[dict[str, Box]]:
        """Bounding box of the target, by camera, for each step; empty without language columns."""
        if not self.dataset.has_language:
            return []
        return [read_boxes(rows) for rows in read_language_rows(self.frame_table, EVENTS, self.where)]

    @cached_property
    def scene(self) -> dict[str, Any]:
        return self._parse_json_text("scene", SceneContent).root

    @cached_property
    def _cameras(self) -> dict[str, CameraRecord]:
        return self._parse_json_text("cameras", CamerasRecord).root

    def _parse_json_text(self, key: str, model: type[_RootModel]) -> _RootModel:
        text, where = self.dataset.scene_json_texts.get(self.number, {}).get(key, "{}"), f"{schema.SCENES_FILE}, {key}"
        return parse_json(model, text, DatasetError, where=f"{self.where}, {where}", about="damaged")

    def _camera(self, name: str) -> CameraRecord:
        if name not in self._cameras:
            what, expected = "no intrinsics and pose of this camera", ", ".join(self._cameras)
            raise DatasetError(what, where=self.where, expected=expected, found=name)
        return self._cameras[name]

    def intrinsic(self, camera: str) -> NDArray[np.float64]:
        return np.array(self._camera(camera).intrinsic)

    def camera_in_parent(self, camera: str) -> NDArray[np.float64]:
        return np.array(self._camera(camera).camera_in_parent)

    def true_camera_in_parent(self, camera: str) -> NDArray[np.float64]:
        record = self._camera(camera)
        return np.array(record.true_camera_in_parent or record.camera_in_parent)

    def camera_parent(self, camera: str) -> Parent:
        return self._camera(camera).parent or standard_camera_parent(camera)

    def find_video(self, camera: str, kind: ImageKind) -> tuple[Path, int]:
        """Return the video file of a camera, and the index of the episode's first frame in that file."""
        prefix = f"videos/{schema.image_key(camera)}"
        if kind == "depth":
            is_native = self.dataset.depth_feature(camera) is not None
            prefix = f"videos/{schema.depth_key(camera)}" if is_native else f"depth/{camera}"
        path = self.dataset.file_layout.episode_path(self.dataset.root, prefix, self.row)
        return path, round(self.row[f"{prefix}/from_timestamp"] * self.dataset.info["fps"])

    def frames(
        self, camera: str, kind: ImageKind = "rgb", first: int = 0, count: int | None = None
    ) -> Generator[NDArray, None, None]:
        path, start = self.find_video(camera, kind)
        count = self.steps - first if count is None else count
        images = read_frames(path, start + first, count, self.dataset.info["fps"])
        feature = self.dataset.depth_feature(camera) if kind == "depth" else None
        return images if feature is None else _decode_depths(images, feature["info"])

    def rgb(self, camera: str, step: int) -> NDArray[np.uint8]:
        (image,) = self.frames(camera, "rgb", step, 1)
        return image

    def depth(self, camera: str, step: int) -> NDArray[np.uint16]:
        (image,) = self.frames(camera, "depth", step, 1)
        return image


def _decode_depths(levels: Generator[NDArray, None, None], info: dict[str, Any]) -> Generator[NDArray, None, None]:
    with closing(levels):
        for image in levels:
            yield to_depth(image, info)


def open_lerobot(root: Path, *, rate_hz: float | None = None, include_failed: bool = False) -> LeRobotDataset:
    """Open a LeRobot dataset; raise DatasetError if ``rate_hz`` is not its rate.

    ``include_failed`` has no effect, because a dataset has all of its episodes.
    """
    dataset = LeRobotDataset(root)
    check_rate(dataset, rate_hz)
    return dataset
