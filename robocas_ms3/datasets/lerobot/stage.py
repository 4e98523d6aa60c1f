"""Writes each episode by itself: its table, its videos, the rest as JSON. A folder appears whole."""

from __future__ import annotations

import time
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import json_text, replacing_folder
from robocas_ms3.datasets.lerobot.arrays import frame_columns
from robocas_ms3.datasets.lerobot.depth import to_levels
from robocas_ms3.datasets.lerobot.language import EVENTS, EVENTS_TYPE, event_rows
from robocas_ms3.datasets.lerobot.schema import MAX_DEPTH_MM, SUBGOAL_TYPE, depth_key, image_key, whole_rate
from robocas_ms3.datasets.lerobot.stats import Levels
from robocas_ms3.datasets.lerobot.table_writing import column
from robocas_ms3.datasets.lerobot.variants import Variant
from robocas_ms3.datasets.lerobot.video import CODINGS, Coding, Encoder
from robocas_ms3.datasets.pictures.boxes import Box
from robocas_ms3.datasets.schema import episode_folder
from robocas_ms3.datasets.sources.protocol import CameraModel, Frame, Kind
from robocas_ms3.datasets.writing.inputs import ConversionInput, complete_arrays
from robocas_ms3.datasets.writing.settings import Timing, WrittenEpisode
from robocas_ms3.robots.cameras import standard_parent

FRAMES_FILE, EPISODE_FILE = "frames.parquet", "episode.json"
SUBGOAL = "subgoal"  # column of texts, which become numbers when parts are joined


def part_folder(parts: Path, index: int) -> Path:
    """Folder of an episode's part."""
    return parts / episode_folder(index)


def is_whole(part: Path) -> bool:
    """Whether a part's files are as large as when they were written."""
    try:
        about = load_json(part / EPISODE_FILE)
        return isinstance(about, dict) and about.get("sizes") == _sizes(part)
    except (OSError, ValueError):
        return False


def _sizes(part: Path) -> dict[str, int]:
    """Bytes of a part's files, without the one that says so."""
    return {file.name: file.stat().st_size for file in sorted(part.iterdir()) if file.name != EPISODE_FILE}


def coding_of(kind: Kind, codec: str, variant: Variant) -> Coding:
    """Return how images of a kind become a video."""
    if kind == "rgb":
        return CODINGS[codec]
    return CODINGS["depth12" if variant.native_depth else "depth"]


def video_name(camera: str, kind: Kind, coding: Coding) -> str:
    """Return the name of a video in a part."""
    return f"{kind}_{camera}{coding.suffix}"


@dataclass(frozen=True)
class PartWriter:
    """Writes each episode by itself, as a part of a LeRobot dataset; can be sent to another process.

    Attributes:
        parts: folder of the parts.
        codec: of RGB.
        variant: what is written.
    """

    parts: Path
    codec: str
    variant: Variant

    def write(self, number: int, given: ConversionInput, source: int) -> WrittenEpisode:
        """Write an episode's part.

        Args:
            number: index of the episode.
            given: what is converted.
            source: its number there.

        Raises:
            DatasetError: it can't be shown or written.
        """
        start, timing, fps = time.perf_counter(), Timing(), whole_rate(given.source.rate_hz)
        with replacing_folder(part_folder(self.parts, number), sync=True) as folder:
            with timing.measure("load"):
                episode = given.source.episode(source)
                arrays = complete_arrays(episode)
            with _Videos(folder, self, fps, timing) as videos, closing(given.frames(episode)) as frames:
                for frame in timing.each(given.stage, frames):
                    videos.add(frame)
            begin_write, steps, scene = time.perf_counter(), int(arrays["episode_length"]), episode.scene
            if videos.steps != steps:
                what = "images and arrays differ in length"
                raise DatasetError(what, where=source, expected=steps, found=videos.steps)
            pq.write_table(self._table(arrays, videos.boxes, scene, fps), folder / FRAMES_FILE)
            about = {
                "steps": steps,
                "instruction": str(arrays["language_goal"]),
                "scene": scene,
                "cameras": {name: _camera(name, episode.camera(name)) for name in given.pictures.cameras},
                "depth": given.pictures.depth,
                "depth_clipped": videos.clipped,
                "levels": {key: levels.counts.tolist() for key, levels in videos.levels.items()},
                "sizes": _sizes(folder),
            }
            text = json_text(about, f"episode {source}", error=DatasetError)
            (folder / EPISODE_FILE).write_text(text, encoding="utf-8")
            size = sum(file.stat().st_size for file in folder.iterdir())
        timing.write += time.perf_counter() - begin_write  # with the folder's renaming
        timing.total += time.perf_counter() - start
        return WrittenEpisode(number, steps, size, timing)

    def _table(
        self, arrays: dict[str, NDArray], boxes: list[dict[str, Box]], scene: dict[str, Any], fps: int
    ) -> pa.Table:
        """Return the rows of an episode, but for the numbers that follow from the episodes before."""
        steps = int(arrays["episode_length"])
        columns: dict[str, Any] = {key: column(values) for key, values in frame_columns(arrays).items()}
        columns[SUBGOAL_TYPE.key] = pa.array(arrays["step_goal_type"].tolist(), pa.string())
        columns["timestamp"] = pa.array((np.arange(steps) / fps).astype(np.float32))
        columns["frame_index"] = pa.array(np.arange(steps))
        columns[SUBGOAL] = pa.array(arrays["step_lang_goals"].tolist(), pa.string())
        if self.variant.language:
            target = str((scene.get("target") or {}).get("name") or "")
            events = [event_rows(found, target) if target.strip() else [] for found in boxes]
            columns[EVENTS] = pa.array(events, EVENTS_TYPE)
        return pa.table(columns)


def _camera(name: str, model: CameraModel) -> dict[str, Any]:
    """Return a camera as `records.CameraRecord`."""
    pose = {"intrinsic": model.intrinsic.tolist(), "camera_in_parent": np.asarray(model.camera_in_parent).tolist()}
    return pose if model.parent == standard_parent(name) else {**pose, "parent": model.parent}


class _Videos:
    """Encode the images of an episode: one encoder per camera and kind, opened with the first frame.

    Attributes:
        levels: counts of the levels of each video of LeRobot, by its feature's key.
        boxes: of each frame.
        steps: number of frames.
        clipped: whether depth was out of the range of a native depth video.
    """

    def __init__(self, folder: Path, writer: PartWriter, fps: int, timing: Timing) -> None:
        self._folder, self._writer, self._fps, self._timing = folder, writer, fps, timing
        self._encoders: dict[tuple[str, str], Encoder] = {}
        self._stack = ExitStack()
        self.levels: dict[str, Levels] = {}
        self.boxes: list[dict[str, Box]] = []
        self.steps, self.clipped = 0, False

    def __enter__(self) -> _Videos:
        return self

    def __exit__(self, *error: Any) -> None:
        with self._timing.measure("encode"):
            self._stack.__exit__(*error)

    def add(self, frame: Frame) -> None:
        with self._timing.measure("encode"):
            for camera, picture in frame.rgb.items():
                self._encoder("rgb", camera, picture).add(picture)
                self.levels.setdefault(image_key(camera), Levels.rgb()).add(picture)
            for camera, picture in frame.depth.items():
                levels = picture
                if self._writer.variant.native_depth:
                    levels = to_levels(picture)
                    self.clipped = self.clipped or bool(picture.max() > MAX_DEPTH_MM)
                    self.levels.setdefault(depth_key(camera), Levels.depth()).add(levels)
                self._encoder("depth", camera, levels).add(levels)
        self.boxes.append(frame.boxes)
        self.steps += 1

    def _encoder(self, kind: Kind, camera: str, picture: NDArray) -> Encoder:
        if (kind, camera) not in self._encoders:
            height, width = picture.shape[:2]
            coding = coding_of(kind, self._writer.codec, self._writer.variant)
            path = self._folder / video_name(camera, kind, coding)
            encoder = self._stack.enter_context(Encoder(path, coding, self._fps, (width, height)))
            self._encoders[kind, camera] = encoder
        return self._encoders[kind, camera]
