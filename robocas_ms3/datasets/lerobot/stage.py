"""Writes each episode by itself: its table, its videos, the rest as JSON. A folder appears whole."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import json_text, replacing_folder
from robocas_ms3.core.workers import Limits
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
from robocas_ms3.datasets.sources.protocol import Kind
from robocas_ms3.datasets.writing.dataset_player import open_player
from robocas_ms3.datasets.writing.frames import Frame
from robocas_ms3.datasets.writing.players import Player, Request
from robocas_ms3.datasets.writing.pool import do_all
from robocas_ms3.datasets.writing.timing import Timing
from robocas_ms3.datasets.writing.writer import WrittenEpisode

FRAMES_FILE, EPISODE_FILE = "frames.parquet", "episode.json"
SUBGOAL = "subgoal"  # column of texts, which become numbers when parts are joined


@dataclass(frozen=True)
class StageJob:
    """What a process needs to know.

    Attributes:
        request: what is converted.
        parts: folder of the parts.
        codec: of RGB.
        variant: what is written.
        tasks: (episode index, number in the source) of those to write.
        limits: of an episode; None: there are none, and one process is this one.
        begun: whether there are parts already.
    """

    request: Request
    parts: Path
    codec: str
    variant: Variant
    tasks: list[tuple[int, int]]
    limits: Limits | None = None
    begun: bool = False


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


def stage_all(job: StageJob, processes: int) -> Generator[WrittenEpisode, None, None]:
    """Write parts; gives each episode when it is done, in any order.

    Raises:
        IncompleteError: episodes can't be written; all others are.
        Exception: what is wrong with all.
    """
    return do_all(
        partial(_Stager, job),
        job.tasks,
        processes,
        job.parts,
        renders=job.request.is_trajectory,
        limits=job.limits,
        apart=job.limits is not None and job.request.renders,
        name=lambda task: episode_folder(task[0]),
        begun=job.begun,
        fix="--resume tries again; with --leave-out too, the others make the dataset where that fails.",
    )


class _Stager:
    """One process's share: keeps what plays the episodes open from one episode to the next."""

    def __init__(self, job: StageJob) -> None:
        self.job, self.player = job, open_player(job.request)

    def run(self, task: tuple[int, int]) -> WrittenEpisode:
        return stage_episode(self.job, self.player, *task)

    def close(self) -> None:
        self.player.close()


def stage_episode(job: StageJob, player: Player, index: int, number: int) -> WrittenEpisode:
    """Write one episode's part.

    Raises:
        DatasetError: it can't be shown or written.
    """
    started, timing, fps = time.perf_counter(), Timing(), whole_rate(player.rate_hz)
    with replacing_folder(part_folder(job.parts, index), sync=True) as folder:
        played = player.open(number, timing)
        with _Videos(folder, job, fps, timing) as videos, closing(played.frames()) as frames:
            for frame in frames:
                videos.add(frame)
        begun, arrays, cameras = time.perf_counter(), played.arrays, played.cameras()
        steps, scene = int(arrays["episode_length"]), played.scene()
        if videos.steps != steps:
            raise DatasetError("pictures and arrays differ in length", where=number, expected=steps, found=videos.steps)
        columns: dict[str, Any] = {key: column(values) for key, values in frame_columns(arrays).items()}
        columns[SUBGOAL_TYPE.key] = pa.array(arrays["step_goal_type"].tolist(), pa.string())
        columns["timestamp"] = pa.array((np.arange(steps) / fps).astype(np.float32))
        columns["frame_index"] = pa.array(np.arange(steps))
        columns[SUBGOAL] = pa.array(arrays["step_lang_goals"].tolist(), pa.string())
        if job.variant.language:
            target = str((scene.get("target") or {}).get("name") or "")
            events = [event_rows(boxes, target) if target.strip() else [] for boxes in videos.boxes]
            columns[EVENTS] = pa.array(events, EVENTS_TYPE)
        pq.write_table(pa.table(columns), folder / FRAMES_FILE)
        about = {
            "steps": steps,
            "instruction": str(arrays["language_goal"]),
            "scene": scene,
            "cameras": {
                name: {
                    "intrinsic": np.asarray(cameras[name].intrinsic).tolist(),
                    "camera_in_parent": np.asarray(cameras[name].camera_in_parent).tolist(),
                }
                for name in player.pictures.cameras
            },
            "depth": player.pictures.depth,
            "depth_clipped": videos.clipped,
            "levels": {key: levels.counts.tolist() for key, levels in videos.levels.items()},
            "sizes": _sizes(folder),
        }
        text = json_text(about, f"episode {number}", error=DatasetError)
        (folder / EPISODE_FILE).write_text(text, encoding="utf-8")
        size = sum(file.stat().st_size for file in folder.iterdir())
    timing.write += time.perf_counter() - begun  # with the folder's renaming
    timing.total += time.perf_counter() - started
    return WrittenEpisode(index, steps, size, timing)


class _Videos:
    """Encode the images of an episode: one encoder per camera and kind, opened with the first frame.

    Attributes:
        levels: counts of the levels of each video of LeRobot, by its feature's key.
        boxes: of each frame.
        steps: number of frames.
        clipped: whether depth was out of the range of a native depth video.
    """

    def __init__(self, folder: Path, job: StageJob, fps: int, timing: Timing) -> None:
        self._folder, self._job, self._fps, self._timing = folder, job, fps, timing
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
                if self._job.variant.native_depth:
                    levels = to_levels(picture)
                    self.clipped = self.clipped or bool(picture.max() > MAX_DEPTH_MM)
                    self.levels.setdefault(depth_key(camera), Levels.depth()).add(levels)
                self._encoder("depth", camera, levels).add(levels)
        self.boxes.append(frame.boxes)
        self.steps += 1

    def _encoder(self, kind: Kind, camera: str, picture: NDArray) -> Encoder:
        if (kind, camera) not in self._encoders:
            height, width = picture.shape[:2]
            coding = coding_of(kind, self._job.codec, self._job.variant)
            path = self._folder / video_name(camera, kind, coding)
            encoder = self._stack.enter_context(Encoder(path, coding, self._fps, (width, height)))
            self._encoders[kind, camera] = encoder
        return self._encoders[kind, camera]
