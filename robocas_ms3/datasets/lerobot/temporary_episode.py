"""Temporary episode folders of a LeRobot conversion; `writer.join_episodes` joins them at the end."""

from __future__ import annotations

from collections.abc import Generator, Iterator
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
from robocas_ms3.core.files import encode_json
from robocas_ms3.datasets.conversion.workers import EpisodeWriter, InputEpisode
from robocas_ms3.datasets.images.image_files import Box
from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.arrays import to_frame_columns
from robocas_ms3.datasets.lerobot.file_models import CameraRecord
from robocas_ms3.datasets.lerobot.language import (
    EVENTS,
    EVENTS_TYPE,
    Row,
    make_event_rows,
    make_paraphrases,
    make_persistent_rows,
)
from robocas_ms3.datasets.lerobot.stats import LevelHistogram
from robocas_ms3.datasets.lerobot.tables import to_column
from robocas_ms3.datasets.lerobot.variants import Variant
from robocas_ms3.datasets.lerobot.video import VideoEncoder, find_codec, to_levels
from robocas_ms3.datasets.schema import episode_folder
from robocas_ms3.datasets.sources.episode_source import ImageKind, StepImages
from robocas_ms3.demos.recordings.subgoals import group_subgoals

FRAMES_FILE, EPISODE_FILE = "frames.parquet", "episode.json"
SUBGOAL = "subgoal"  # column of texts; they become indices when the episodes are joined


class EpisodeRecord(BaseModel):
    """Content of ``episode.json`` of a temporary episode folder.

    Attributes:
        instruction: instruction of the episode.
        scene: content of ``scene.json``.
        cameras: intrinsics and poses by camera.
        depth: whether there are depth videos.
        depth_clipped: whether depth was above the largest value of a depth video.
        levels: histogram of pixel values (channels, levels) by video feature.
        sizes: bytes by file.
    """

    model_config = ConfigDict(strict=True)

    instruction: str
    scene: dict[str, Any]
    cameras: dict[str, CameraRecord]
    depth: bool
    depth_clipped: bool
    levels: dict[str, list[list[int]]]
    sizes: dict[str, int]


def video_name(camera: str, kind: ImageKind, codec: str, variant: Variant) -> str:
    """Return the file name of a video in a temporary episode folder; ``codec``: name of the RGB codec."""
    return f"{kind}_{camera}{find_codec(kind, codec, variant).suffix}"


def _file_sizes(folder: Path) -> dict[str, int]:
    return {file.name: file.stat().st_size for file in sorted(folder.iterdir()) if file.name != EPISODE_FILE}


@dataclass(frozen=True)
class TemporaryEpisodeWriter(EpisodeWriter):
    """Writes temporary episode folders of a LeRobot conversion into ``root``.

    ``codec`` is the name of the RGB codec.
    """

    root: Path
    codec: str
    variant: Variant

    def folder(self, number: int) -> Path:
        return self.root / episode_folder(number)

    def write_files(self, folder: Path, episode: InputEpisode, frames: Generator[StepImages, None, None]) -> None:
        source, arrays, image_options = episode.source_episode, episode.arrays, episode.conversion_input.image_options
        fps, steps = schema.to_integer_rate(episode.conversion_input.source.rate_hz), int(arrays["episode_length"])
        encoders: dict[str, VideoEncoder] = {}  # opened at the first frame
        levels: dict[str, LevelHistogram] = {}
        boxes: list[dict[str, Box]] = []
        clipped = False
        with ExitStack() as stack:
            for frame in frames:
                boxes.append(frame.boxes)
                for camera, kind, image in _iter_images(frame):
                    if kind == "rgb":
                        levels.setdefault(schema.image_key(camera), LevelHistogram.make_rgb()).add(image)
                    elif self.variant.native_depth:
                        clipped = clipped or bool(image.max() > schema.MAX_DEPTH_MM)
                        image = to_levels(image)  # noqa: PLW2901
                        levels.setdefault(schema.depth_key(camera), LevelHistogram.make_depth()).add(image)
                    name = video_name(camera, kind, self.codec, self.variant)
                    if name not in encoders:
                        found_codec, size = find_codec(kind, self.codec, self.variant), (image.shape[1], image.shape[0])
                        encoders[name] = stack.enter_context(VideoEncoder(folder / name, found_codec, fps, size))
                    encoders[name].add(image)
        if len(boxes) != steps:
            what = "images and arrays have different lengths"
            raise DatasetError(what, where=source.where, expected=steps, found=len(boxes))
        scene = source.scene
        pq.write_table(self._make_table(arrays, boxes, scene, fps), folder / FRAMES_FILE)
        record = EpisodeRecord(
            instruction=str(arrays["language_goal"]),
            scene=scene,
            cameras={name: CameraRecord.from_model(name, source.camera(name)) for name in image_options.cameras},
            depth=image_options.depth,
            depth_clipped=clipped,
            levels={key: counted.counts.tolist() for key, counted in levels.items()},
            sizes=_file_sizes(folder),
        )
        text = encode_json(record.model_dump(), source.where, error=DatasetError)
        (folder / EPISODE_FILE).write_text(text, encoding="utf-8")

    def _make_table(
        self, arrays: dict[str, NDArray], boxes: list[dict[str, Box]], scene: dict[str, Any], fps: int
    ) -> pa.Table:
        """Make the table of frames, without the indices that depend on other episodes."""
        steps = int(arrays["episode_length"])
        columns: dict[str, Any] = {key: to_column(values) for key, values in to_frame_columns(arrays).items()}
        columns[schema.SUBGOAL_TYPE.key] = pa.array(arrays["step_goal_type"].tolist(), pa.string())
        columns["timestamp"] = pa.array((np.arange(steps) / fps).astype(np.float32))
        columns["frame_index"] = pa.array(np.arange(steps))
        columns[SUBGOAL] = pa.array(arrays["step_lang_goals"].tolist(), pa.string())
        if self.variant.language:
            target = str((scene.get("target") or {}).get("name") or "")
            events = [make_event_rows(found, target) if target.strip() else [] for found in boxes]
            columns[EVENTS] = pa.array(events, EVENTS_TYPE)
        return pa.table(columns)


def _iter_images(frame: StepImages) -> Iterator[tuple[str, ImageKind, NDArray]]:
    for camera, image in frame.rgb.items():
        yield camera, "rgb", image
    for camera, image in frame.depth.items():
        yield camera, "depth", image


@dataclass(frozen=True)
class TemporaryEpisode:
    """Temporary folder of one episode of a LeRobot conversion."""

    folder: Path

    @property
    def is_complete(self) -> bool:
        try:
            return self.record.sizes == _file_sizes(self.folder)
        except (DatasetError, OSError):
            return False

    @cached_property
    def record(self) -> EpisodeRecord:
        path = self.folder / EPISODE_FILE
        try:
            return EpisodeRecord.model_validate_json(read_text(path, JSON_LIMIT))
        except (OSError, ValueError) as error:
            raise _damaged_file_error(path) from error

    @cached_property
    def frame_table(self) -> pa.Table:
        path = self.folder / FRAMES_FILE
        try:
            return pq.read_table(path)
        except (OSError, pa.ArrowException) as error:
            raise _damaged_file_error(path) from error

    def make_persistent_rows(self, fps: int) -> list[Row]:
        types, goals = (self.frame_table.column(key).to_pylist() for key in (schema.SUBGOAL_TYPE.key, SUBGOAL))
        texts = make_paraphrases(self.record.scene, self.record.instruction)
        return make_persistent_rows(group_subgoals(types, goals), texts, fps)


def _damaged_file_error(path: Path) -> DatasetError:
    return DatasetError("damaged temporary file of a conversion", where=path, fix="Pass --overwrite to start again.")
