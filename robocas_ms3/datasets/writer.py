"""Writes one episode's folder: pictures while they are rendered, arrays at the end; the folder appears whole."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.episode import (
    Frames,
    episode_arrays,
    gripper_open,
    sample_states,
    sample_subgoals,
)
from robocas_ms3.datasets.trajectory import Recording
from robocas_ms3.errors import DatasetError
from robocas_ms3.files import replacing_folder

ENCODERS = 2  # threads; OpenCV encodes outside Python's lock
_MAX_WAITING = 24  # pictures, which bounds memory
PNG_LEVEL = [cv2.IMWRITE_PNG_COMPRESSION, 1]


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
        depth: camera -> (H, W) uint16, mm.
        tcp_in_world, arm_base_in_world: (4, 4).
    """

    rgb: dict[str, NDArray[np.uint8]]
    depth: dict[str, NDArray[np.uint16]]
    tcp_in_world: NDArray[np.float64]
    arm_base_in_world: NDArray[np.float64]


class FrameSource(Protocol):
    """Shows recorded states; the renderer is one, tests bring another."""

    gripper_column: int
    finger_range: tuple[float, float]

    def load(self, recording: Recording) -> None:
        """Build the recording's scene."""
        ...

    def frames(self, recording: Recording, samples: NDArray[np.int64]) -> Iterator[Frame]:
        """Show some of its states."""
        ...

    def cameras(self) -> dict[str, CameraModel]:
        """The cameras, at the state shown last."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


@dataclass
class Timing:
    """Where the time of an episode went, s. Encoding overlaps rendering, on other threads."""

    load: float = 0.0
    render: float = 0.0
    encode: float = 0.0
    wait: float = 0.0
    total: float = 0.0


@dataclass(frozen=True)
class WrittenEpisode:
    """An episode on disk: its number in the dataset, T, bytes, and what it took."""

    number: int
    steps: int
    size: int
    timing: Timing


def write_episode(
    root: Path, number: int, recording: Recording, source: FrameSource, *, stride: int, embed=None
) -> WrittenEpisode:
    """Render a recording and write its folder.

    Args:
        root: the dataset.
        number: of the episode in it.
        recording: what to write.
        source: shows its states.
        stride: control steps a dataset step.
        embed: texts -> (N, 384); None leaves the embeddings out.

    Raises:
        DatasetError: too long for four digits, or a file can't be written.
    """
    started = time.perf_counter()
    timing = Timing()
    samples = sample_states(recording.control_steps, stride)
    subgoals = sample_subgoals(recording.subgoals, samples)
    if len(samples) > schema.MAX_STEPS:
        raise DatasetError(
            "too many steps", where=f"episode {number}", expected=f"<= {schema.MAX_STEPS}", found=len(samples)
        )
    source.load(recording)
    timing.load = time.perf_counter() - started
    with replacing_folder(root / schema.episode_folder(number)) as folder:
        for camera in schema.CAMERAS:
            for kind in schema.IMAGE_KINDS:
                (folder / camera.name / kind).mkdir(parents=True)
        tcp, base = _write_pictures(folder, source.frames(recording, samples), timing)
        for camera in schema.CAMERAS:
            model = source.cameras()[camera.name]
            np.save(folder / camera.name / schema.INTRINSIC_FILE, model.intrinsic)
            for name in camera.pose_files:
                np.save(folder / camera.name / name, model.camera_in_parent)
        joints = recording.joints(samples)
        status = gripper_open(
            recording.actions[:, source.gripper_column],
            samples,
            finger_range=source.finger_range,
            initial_width=float(joints.qpos[0, 10:12].sum()),
        )
        arrays = episode_arrays(Frames(tcp, base), joints, status, recording.instruction, subgoals, embed)
        np.savez(folder / schema.EPISODE_FILE, **arrays)
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    timing.total = time.perf_counter() - started
    return WrittenEpisode(number, len(samples), size, timing)


def _write_pictures(folder: Path, frames: Iterator[Frame], timing: Timing) -> tuple[NDArray, NDArray]:
    """Encode pictures on other threads while the next state renders; gives the poses (T, 4, 4) of TCP and arm base."""
    poses = []
    waiting: deque[Future[float]] = deque()

    def collect(limit: int) -> None:
        begun = time.perf_counter()
        while len(waiting) > limit:
            timing.encode += waiting.popleft().result()
        timing.wait += time.perf_counter() - begun

    with ThreadPoolExecutor(ENCODERS, thread_name_prefix="png") as encoders:
        begun = time.perf_counter()
        for step, frame in enumerate(frames):
            timing.render += time.perf_counter() - begun
            poses.append((frame.tcp_in_world, frame.arm_base_in_world))
            for camera in schema.CAMERAS:
                for kind, picture in (("rgb", frame.rgb[camera.name]), ("depth", frame.depth[camera.name])):
                    path = schema.image_path(folder, camera.name, kind, step)
                    waiting.append(encoders.submit(_write_png, path, picture))
            collect(_MAX_WAITING)
            begun = time.perf_counter()
        collect(0)
    tcp, base = (np.stack(column) for column in zip(*poses, strict=True))
    return tcp, base


def _write_png(path: Path, picture: NDArray) -> float:
    begun = time.perf_counter()
    if picture.ndim == 3:
        picture = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    try:
        written = cv2.imwrite(str(path), picture, PNG_LEVEL)
    except cv2.error as error:
        raise DatasetError("can't encode this picture", where=path, found=str(error).splitlines()[0]) from error
    if not written:
        raise DatasetError("can't write this picture", where=path, fix="Is the disk full?")
    return time.perf_counter() - begun
