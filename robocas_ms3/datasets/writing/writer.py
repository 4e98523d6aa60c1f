"""Writes one episode's folder: pictures while they are rendered, the rest at the end; the folder appears whole."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import json_text, replacing_folder
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.drawing import Story
from robocas_ms3.datasets.pictures.preview import Preview
from robocas_ms3.datasets.pictures.stored import Pictures, write_picture
from robocas_ms3.datasets.sources.arrays import with_embeddings
from robocas_ms3.datasets.writing.frames import CameraModel, Frame
from robocas_ms3.datasets.writing.players import Player
from robocas_ms3.datasets.writing.timing import Timing

ENCODERS = 2  # threads; ISA-L and OpenCV work outside Python's lock
_MAX_WAITING = 24  # pictures, which bounds memory


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


def write_episode(
    root: Path,
    number: int,
    player: Player,
    source: int,
    *,
    embed: Callable[[list[str]], NDArray] | None = None,
    open_preview: Callable[[Story], Preview] | None = None,
) -> WrittenEpisode:
    """Play an episode and write its folder.

    Args:
        root: the dataset.
        number: of the episode in it.
        player: gives it.
        source: its number there.
        embed: texts -> (N, 384); None leaves the embeddings out.
        open_preview: begins its preview; None: there is none.

    Raises:
        DatasetError: it can't be shown, or a file can't be written.
    """
    started, timing, pictures = time.perf_counter(), Timing(), player.pictures
    with replacing_folder(root / schema.episode_folder(number), sync=True) as folder:
        for camera in pictures.cameras:
            for kind in pictures.kinds:
                (folder / camera / kind).mkdir(parents=True)
        played = player.open(source, timing)
        with (
            ExitStack() as previews,
            _Encoders(folder, pictures, timing) as encoders,
            closing(played.frames()) as frames,
        ):
            if open_preview:  # finished after the encoders
                encoders.preview = previews.enter_context(open_preview(Story.of(number, played.arrays)))
            for step, frame in enumerate(frames):
                encoders.add(step, frame)
        with timing.measure("write"):
            cameras = played.cameras()
            write_cameras(folder, {name: cameras[name] for name in pictures.cameras})
            arrays: dict[str, Any] = with_embeddings(played.arrays, embed) if embed else played.arrays
            np.savez(folder / schema.EPISODE_FILE, **arrays)
            text = json_text(played.scene(), f"episode {source}", indent=1, error=DatasetError)
            (folder / schema.SCENE_FILE).write_text(text + "\n", encoding="utf-8")
            size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        renaming = time.perf_counter()
    timing.write += time.perf_counter() - renaming
    timing.total += time.perf_counter() - started
    return WrittenEpisode(number, len(arrays["ee_pos"]), size, timing, encoders.preview and encoders.preview.row)


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
