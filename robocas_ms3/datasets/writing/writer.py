"""Writes one episode's folder: pictures while they are rendered, the rest at the end; the folder appears whole."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.drawing import Story
from robocas_ms3.datasets.pictures.preview import Preview
from robocas_ms3.datasets.pictures.stored import Pictures, write_picture
from robocas_ms3.datasets.sources.arrays import episode_arrays
from robocas_ms3.datasets.writing.timing import Timing
from robocas_ms3.errors import DatasetError
from robocas_ms3.files import replacing_folder
from robocas_ms3.recordings.motion import sample_states
from robocas_ms3.recordings.reading import Recording
from robocas_ms3.recordings.subgoals import SubGoal, sample_subgoals

ENCODERS = 2  # threads; ISA-L and OpenCV work outside Python's lock
_MAX_WAITING = 24  # pictures, which bounds memory


@dataclass(frozen=True)
class CameraModel:
    """What does not change during an episode.

    Attributes:
        intrinsic: (4,) fx, fy, cx, cy, pixels.
        camera_in_parent: (4, 4) OpenCV camera frame.
    """

    intrinsic: NDArray[np.float64]
    camera_in_parent: NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """What is seen at one state.

    Attributes:
        rgb: camera -> (H, W, 3) uint8.
        depth: camera -> (H, W) uint16, mm; empty where depth is not wanted.
    """

    rgb: dict[str, NDArray[np.uint8]]
    depth: dict[str, NDArray[np.uint16]]


class FrameSource(Protocol):
    """Shows recorded states; the renderer is one, tests bring another."""

    def load(self, recording: Recording) -> None:
        """Build the recording's scene."""
        ...

    def frames(self, recording: Recording, samples: NDArray[np.int64]) -> Iterator[Frame]:
        """Show some of its states."""
        ...

    def cameras(self) -> dict[str, CameraModel]:
        """The cameras, at the state shown last."""
        ...

    def scene(self) -> dict[str, Any]:
        """What ``scene.json`` says of the scene: ``task``, ``config``, ``layout``, ``objects``."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


@dataclass(frozen=True)
class Shown:
    """A rendered episode, all but its pictures.

    Attributes:
        arrays: of ``episode_info.npz``.
        cameras: by name.
        scene: see ``FrameSource.scene``.
    """

    arrays: dict[str, np.ndarray]
    cameras: dict[str, CameraModel]
    scene: dict[str, Any]


@dataclass(frozen=True)
class WrittenEpisode:
    """An episode on disk.

    Attributes:
        number: in the dataset.
        steps: T.
        size: bytes.
        timing: what it took.
        row: its part of the contact sheet, (H, W, 3) RGB, where one was wanted.
    """

    number: int
    steps: int
    size: int
    timing: Timing
    row: NDArray[np.uint8] | None = None


def show_episode(
    recording: Recording,
    source: FrameSource,
    *,
    stride: int,
    embed: Callable[[list[str]], NDArray] | None,
    on_frame: Callable[[int, Frame], None],
    on_start: Callable[[list[SubGoal], NDArray[np.bool_]], None] | None = None,
    timing: Timing | None = None,
) -> Shown:
    """Render a recording and hand over its pictures one step at a time.

    Args:
        recording: what to show.
        source: shows its states.
        stride: control steps a dataset step.
        embed: texts -> (N, 384); None leaves the embeddings out.
        on_frame: called with step and frame.
        on_start: called before, with the sub-goals over the T steps and the gripper's command (T,) at each, 1 = open.
        timing: what this took is added to it.

    Raises:
        DatasetError: too long for four digits, or the scene can't be shown.
    """
    timing = timing or Timing()
    samples = sample_states(recording.control_steps, stride)
    subgoals = sample_subgoals(recording.subgoals, samples)
    if len(samples) > schema.MAX_STEPS:
        where = f"episode {recording.episode_id}"
        raise DatasetError("too many steps", where=where, expected=f"<= {schema.MAX_STEPS}", found=len(samples))
    with timing.measure("load"):
        source.load(recording)
    motion = recording.motion(samples)
    if on_start:
        on_start(subgoals, motion.gripper_open)
    begun = time.perf_counter()
    for step, frame in enumerate(source.frames(recording, samples)):
        timing.render += time.perf_counter() - begun
        on_frame(step, frame)
        begun = time.perf_counter()
    with timing.measure("write"):
        arrays = episode_arrays(motion, recording.instruction, subgoals, embed)
    return Shown(arrays, source.cameras(), source.scene())


def write_episode(
    root: Path,
    number: int,
    recording: Recording,
    source: FrameSource,
    *,
    stride: int,
    pictures: Pictures,
    describe: Callable[[dict[str, Any]], dict[str, Any]],
    embed: Callable[[list[str]], NDArray] | None = None,
    open_preview: Callable[[Story], Preview] | None = None,
    timing: Timing | None = None,
) -> WrittenEpisode:
    """Render a recording and write its folder.

    Args:
        root: the dataset.
        number: of the episode in it.
        recording: what to write.
        source: shows its states.
        stride: control steps a dataset step.
        pictures: which ones.
        describe: makes ``scene.json`` of what the source says of the scene.
        embed: texts -> (N, 384); None leaves the embeddings out.
        open_preview: begins its preview; None: there is none.
        timing: of the episode so far; what this took is added to it.

    Raises:
        DatasetError: too long for four digits, or a file can't be written.
    """
    started, timing = time.perf_counter(), timing or Timing()
    with replacing_folder(root / schema.episode_folder(number)) as folder:
        for camera in pictures.cameras:
            for kind in pictures.kinds:
                (folder / camera / kind).mkdir(parents=True)
        with ExitStack() as previews, _Encoders(folder, pictures, timing) as encoders:

            def begin_preview(goals: list[SubGoal], gripper_status: NDArray[np.bool_]) -> None:
                if open_preview:
                    story = _story(number, recording.instruction, goals, gripper_status)
                    encoders.preview = previews.enter_context(open_preview(story))  # finished after the encoders

            shown = show_episode(
                recording,
                source,
                stride=stride,
                embed=embed,
                on_frame=encoders.add,
                on_start=begin_preview,
                timing=timing,
            )
        begun = time.perf_counter()
        write_cameras(folder, {name: shown.cameras[name] for name in pictures.cameras})
        np.savez(folder / schema.EPISODE_FILE, **shown.arrays)
        text = json.dumps(describe(shown.scene), indent=1, ensure_ascii=False)
        (folder / schema.SCENE_FILE).write_text(text + "\n", encoding="utf-8")
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    timing.write += time.perf_counter() - begun  # with the folder's renaming
    timing.total += time.perf_counter() - started
    return WrittenEpisode(number, len(shown.arrays["ee_pos"]), size, timing, encoders.preview and encoders.preview.row)


def _story(number: int, instruction: str, goals: list[SubGoal], gripper_status: NDArray[np.bool_]) -> Story:
    steps = [goal for goal in goals for _ in range(goal.last - goal.first + 1)]
    types, texts = [goal.goal_type for goal in steps], [goal.goal_description for goal in steps]
    return Story(number, instruction, types, texts, gripper_status)


def write_cameras(folder: Path, cameras: dict[str, CameraModel]) -> None:
    """Write intrinsics and poses into an episode's folder."""
    for camera in schema.CAMERAS:
        if camera.name in cameras:
            model = cameras[camera.name]
            (folder / camera.name).mkdir(exist_ok=True)
            np.save(folder / camera.name / schema.INTRINSIC_FILE, model.intrinsic)
            for name in camera.pose_files:
                np.save(folder / camera.name / name, model.camera_in_parent)


class _Encoders:
    """Encodes pictures on other threads while the next state renders."""

    def __init__(self, folder: Path, pictures: Pictures, timing: Timing) -> None:
        self._folder, self._pictures, self._timing = folder, pictures, timing
        self._waiting: deque[Future[float]] = deque()
        self._pool = ThreadPoolExecutor(ENCODERS, thread_name_prefix="pictures")
        self._in_order = ThreadPoolExecutor(1, thread_name_prefix="preview")  # a video's frames are
        self.preview: Preview | None = None

    def __enter__(self) -> _Encoders:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self._collect(0)
        finally:
            for pool in (self._pool, self._in_order):
                pool.shutdown(cancel_futures=True)

    def add(self, step: int, frame: Frame) -> None:
        """Take a frame; waits where too many are waiting."""
        for kind in self._pictures.kinds:
            shots = frame.rgb if kind == "rgb" else frame.depth
            for camera in self._pictures.cameras:
                path = schema.image_path(self._folder, camera, kind, step, self._pictures.image_format)
                self._waiting.append(self._pool.submit(write_picture, path, shots[camera]))
        if self.preview:
            self._waiting.append(self._in_order.submit(self.preview.add, step, frame.rgb))
        self._collect(_MAX_WAITING)

    def _collect(self, limit: int) -> None:
        with self._timing.measure("wait"):
            while len(self._waiting) > limit:
                self._timing.encode += self._waiting.popleft().result()
