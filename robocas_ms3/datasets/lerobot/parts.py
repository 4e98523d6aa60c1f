"""Parts of a conversion: each episode is written by itself, and read when all are joined. A folder appears whole."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from robocas_ms3.core.documents import JSON_LIMIT, read_text
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.arrays import frame_columns
from robocas_ms3.datasets.lerobot.language import (
    EVENTS,
    EVENTS_TYPE,
    Row,
    event_rows,
    paraphrases,
    persistent_rows,
)
from robocas_ms3.datasets.lerobot.records import CameraRecord
from robocas_ms3.datasets.lerobot.stats import Levels
from robocas_ms3.datasets.lerobot.tables import as_column
from robocas_ms3.datasets.lerobot.variants import Variant
from robocas_ms3.datasets.lerobot.video import Encoder, coding_of, to_levels
from robocas_ms3.datasets.pictures.stored import Box
from robocas_ms3.datasets.schema import episode_folder
from robocas_ms3.datasets.sources.protocol import Frame, Kind
from robocas_ms3.datasets.writing.workers import EpisodeWriter, GivenEpisode
from robocas_ms3.demos.recordings.subgoals import subgoal_runs

FRAMES_FILE, EPISODE_FILE = "frames.parquet", "episode.json"
SUBGOAL = "subgoal"  # column of texts, which become numbers when parts are joined


class EpisodeRecord(BaseModel):
    """``episode.json`` of a part.

    Attributes:
        instruction: of the episode.
        scene: content of ``scene.json``.
        cameras: by name.
        depth: whether there are videos of depth.
        depth_clipped: whether depth was out of the range of a native depth video.
        levels: counts of the levels of each video feature, see `stats.Levels`.
        sizes: bytes of the other files of the part.
    """

    model_config = ConfigDict(strict=True)

    instruction: str
    scene: dict[str, Any]
    cameras: dict[str, CameraRecord]
    depth: bool
    depth_clipped: bool
    levels: dict[str, list[list[int]]]
    sizes: dict[str, int]


def video_name(camera: str, kind: Kind, codec: str, variant: Variant) -> str:
    return f"{kind}_{camera}{coding_of(kind, codec, variant).suffix}"


def _sizes(folder: Path) -> dict[str, int]:
    return {file.name: file.stat().st_size for file in sorted(folder.iterdir()) if file.name != EPISODE_FILE}


@dataclass(frozen=True)
class PartWriter(EpisodeWriter):
    """Writes the parts of a LeRobot dataset.

    Attributes:
        parts: folder of the parts.
        codec: of RGB.
        variant: of the dataset.
    """

    parts: Path
    codec: str
    variant: Variant

    def folder(self, number: int) -> Path:
        """Return the folder of a part."""
        return self.parts / episode_folder(number)

    def write_files(self, folder: Path, wanted: GivenEpisode, frames: Generator[Frame, None, None]) -> None:
        """Write a part into a folder."""
        episode, arrays, pictures = wanted.episode, wanted.arrays, wanted.given.pictures
        fps, steps = schema.whole_rate(wanted.given.source.rate_hz), int(arrays["episode_length"])
        with _Videos(folder, self, fps) as videos:
            for frame in frames:
                videos.add(frame)
        if len(videos.boxes) != steps:
            what = "images and arrays differ in length"
            raise DatasetError(what, where=episode.where, expected=steps, found=len(videos.boxes))
        scene = episode.scene
        pq.write_table(self._table(arrays, videos.boxes, scene, fps), folder / FRAMES_FILE)
        record = EpisodeRecord(
            instruction=str(arrays["language_goal"]),
            scene=scene,
            cameras={name: CameraRecord.of(name, episode.camera(name)) for name in pictures.cameras},
            depth=pictures.depth,
            depth_clipped=videos.clipped,
            levels={key: levels.counts.tolist() for key, levels in videos.levels.items()},
            sizes=_sizes(folder),
        )
        (folder / EPISODE_FILE).write_text(record.model_dump_json(), encoding="utf-8")

    def _table(
        self, arrays: dict[str, NDArray], boxes: list[dict[str, Box]], scene: dict[str, Any], fps: int
    ) -> pa.Table:
        """Return the frames, without the numbers that depend on other episodes."""
        steps = int(arrays["episode_length"])
        columns: dict[str, Any] = {key: as_column(values) for key, values in frame_columns(arrays).items()}
        columns[schema.SUBGOAL_TYPE.key] = pa.array(arrays["step_goal_type"].tolist(), pa.string())
        columns["timestamp"] = pa.array((np.arange(steps) / fps).astype(np.float32))
        columns["frame_index"] = pa.array(np.arange(steps))
        columns[SUBGOAL] = pa.array(arrays["step_lang_goals"].tolist(), pa.string())
        if self.variant.language:
            target = str((scene.get("target") or {}).get("name") or "")
            events = [event_rows(found, target) if target.strip() else [] for found in boxes]
            columns[EVENTS] = pa.array(events, EVENTS_TYPE)
        return pa.table(columns)


class _Videos:
    """Encodes the images of an episode: one encoder per camera and kind, opened with the first frame.

    Attributes:
        levels, clipped: see `EpisodeRecord`.
        boxes: of each frame.
    """

    def __init__(self, folder: Path, writer: PartWriter, fps: int) -> None:
        self._folder, self._writer, self._fps = folder, writer, fps
        self._encoders: dict[str, Encoder] = {}
        self._stack = ExitStack()
        self.levels: dict[str, Levels] = {}
        self.boxes: list[dict[str, Box]] = []
        self.clipped = False

    def __enter__(self) -> _Videos:
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def add(self, frame: Frame) -> None:
        for camera, image in frame.rgb.items():
            self._encode("rgb", camera, image)
            self.levels.setdefault(schema.image_key(camera), Levels.rgb()).add(image)
        for camera, image in frame.depth.items():
            if self._writer.variant.native_depth:
                self.clipped = self.clipped or bool(image.max() > schema.MAX_DEPTH_MM)
                image = to_levels(image)  # noqa: PLW2901
                self.levels.setdefault(schema.depth_key(camera), Levels.depth()).add(image)
            self._encode("depth", camera, image)
        self.boxes.append(frame.boxes)

    def _encode(self, kind: Kind, camera: str, image: NDArray) -> None:
        name = video_name(camera, kind, self._writer.codec, self._writer.variant)
        if name not in self._encoders:
            height, width = image.shape[:2]
            coding = coding_of(kind, self._writer.codec, self._writer.variant)
            encoder = Encoder(self._folder / name, coding, self._fps, (width, height))
            self._encoders[name] = self._stack.enter_context(encoder)
        self._encoders[name].add(image)


@dataclass(frozen=True)
class Part:
    """An episode that was written by itself."""

    folder: Path

    @property
    def is_whole(self) -> bool:
        """Whether its files are as large as when they were written."""
        try:
            return self.record.sizes == _sizes(self.folder)
        except (DatasetError, OSError):
            return False

    @cached_property
    def record(self) -> EpisodeRecord:
        """Its ``episode.json``.

        Raises:
            DatasetError: it is damaged.
        """
        path = self.folder / EPISODE_FILE
        try:
            return EpisodeRecord.model_validate_json(read_text(path, JSON_LIMIT))
        except (OSError, ValueError) as error:
            raise _damaged(path) from error

    @cached_property
    def table(self) -> pa.Table:
        """Its frames."""
        path = self.folder / FRAMES_FILE
        try:
            return pq.read_table(path)
        except (OSError, pa.ArrowException) as error:
            raise _damaged(path) from error

    def persistent_rows(self, fps: int) -> list[Row]:
        types, goals = (self.table.column(key).to_pylist() for key in (schema.SUBGOAL_TYPE.key, SUBGOAL))
        texts = paraphrases(self.record.scene, self.record.instruction)
        return persistent_rows(subgoal_runs(types, goals), texts, fps)


def _damaged(path: Path) -> DatasetError:
    return DatasetError("this part of a conversion is damaged", where=path, fix="Pass --overwrite.")
