"""Writes the folder of an episode: images while they are rendered, the rest at the end; the folder appears whole."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.documents import DAMAGED, DocumentError, load_array, load_json
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import json_text, replacing_folder
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.drawing import Story
from robocas_ms3.datasets.pictures.headers import has_both_ends
from robocas_ms3.datasets.pictures.preview import Preview
from robocas_ms3.datasets.pictures.stored import Pictures, write_picture
from robocas_ms3.datasets.sources.arrays import with_embeddings
from robocas_ms3.datasets.sources.files import CAMERA_LIMIT
from robocas_ms3.datasets.sources.protocol import CameraModel, Frame
from robocas_ms3.datasets.sources.tolerant import read_arrays
from robocas_ms3.datasets.writing.inputs import ConversionInput, complete_arrays
from robocas_ms3.datasets.writing.settings import Timing, WrittenEpisode

ENCODERS = 2  # threads; ISA-L and OpenCV work outside Python's lock
_MAX_WAITING = 24  # images, which bounds memory


@dataclass(frozen=True)
class FolderWriter:
    """Writes episodes of a RoboCAS folder; can be sent to another process.

    Attributes:
        out: the dataset.
        embed: texts -> (N, 384); None leaves the embeddings out.
        sheet: episodes on the contact sheet; None: no previews are made.
    """

    out: Path
    embed: Callable[[list[str]], NDArray[np.float32]] | None = None
    sheet: tuple[int, ...] | None = None

    def write(self, number: int, given: ConversionInput, source: int) -> WrittenEpisode:
        """Write episode ``source`` of the input as episode ``number`` of the dataset."""
        start, timing, pictures = time.perf_counter(), Timing(), given.pictures
        with replacing_folder(self.out / schema.episode_folder(number), sync=True) as folder:
            for camera in pictures.cameras:
                for kind in pictures.kinds:
                    (folder / camera / kind).mkdir(parents=True)
            with timing.measure("load"):
                episode = given.source.episode(source)
                arrays: dict[str, Any] = complete_arrays(episode)
            with (
                ExitStack() as previews,
                _Encoders(folder, pictures, timing) as encoders,
                closing(given.frames(episode)) as frames,
            ):
                if self.sheet is not None:  # finished after the encoders
                    story, row = Story.of(number, arrays), number in self.sheet
                    preview = Preview(self.out, given.source.rate_hz, story, row=row)
                    encoders.preview = previews.enter_context(preview)
                for step, frame in enumerate(timing.each(given.stage, frames)):
                    encoders.add(step, frame)
            begin_write = time.perf_counter()
            write_cameras(folder, {name: episode.camera(name) for name in pictures.cameras})
            arrays = with_embeddings(arrays, self.embed) if self.embed else arrays
            np.savez(folder / schema.EPISODE_FILE, **arrays)
            text = json_text(episode.scene, f"episode {source}", indent=1, error=DatasetError)
            (folder / schema.SCENE_FILE).write_text(text + "\n", encoding="utf-8")
            size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        timing.write += time.perf_counter() - begin_write  # with the renaming of the folder
        timing.total += time.perf_counter() - start
        return WrittenEpisode(number, len(arrays["ee_pos"]), size, timing, encoders.preview and encoders.preview.row)


def write_cameras(folder: Path, cameras: Mapping[str, CameraModel]) -> None:
    """Write intrinsics and poses into an episode's folder."""
    for camera, model in cameras.items():
        (folder / camera).mkdir(exist_ok=True)
        np.save(folder / camera / schema.INTRINSIC_FILE, model.intrinsic)
        for name in schema.pose_files(model.parent):
            np.save(folder / camera / name, model.camera_in_parent)


class _Encoders:
    """Encodes images on other threads while the next state renders."""

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
        """Take a frame; waits if too many images are waiting."""
        for kind in self._pictures.kinds:
            images = frame.rgb if kind == "rgb" else frame.depth
            for camera in self._pictures.cameras:
                path = schema.image_path(self._folder, camera, kind, step, self._pictures.image_format)
                self._waiting.append(self._pool.submit(write_picture, path, images[camera]))
        if self.preview:
            self._waiting.append(self._in_order.submit(self.preview.add, step, frame.rgb))
        self._collect(_MAX_WAITING)

    def _collect(self, limit: int) -> None:
        with self._timing.measure("wait"):
            while len(self._waiting) > limit:
                self._timing.encode += self._waiting.popleft().result()


def find_damaged(folder: Path, pictures: Pictures) -> Path | None:
    """Return the first file of an episode that is missing or was cut off since it was written.

    A file that is cut off lacks its end, so little is read. Other damage is found by ``robocas validate``.

    Args:
        folder: of the episode.
        pictures: images that it should hold.
    """
    length = "episode_length"
    steps = read_arrays(folder / schema.EPISODE_FILE, (length,)).arrays.get(length)
    if steps is None or steps.ndim:
        return folder / schema.EPISODE_FILE
    small = [folder / schema.SCENE_FILE]
    for camera in pictures.cameras:
        files = (schema.INTRINSIC_FILE, *schema.pose_files(schema.camera_parent(folder / camera)))
        small += [folder / camera / name for name in files]
    images = (
        schema.image_path(folder, camera, kind, step, pictures.image_format)
        for camera in pictures.cameras
        for kind in pictures.kinds
        for step in range(int(steps))
    )
    wrong = (path for path in small if not _is_readable(path))
    return next(wrong, None) or next((path for path in images if not _has_end(path)), None)


def _is_readable(path: Path) -> bool:
    try:
        load_json(path) if path.suffix == ".json" else load_array(path, CAMERA_LIMIT)
    except DAMAGED:
        return False
    return True


def _has_end(path: Path) -> bool:
    try:
        return has_both_ends(path)
    except (OSError, DocumentError):
        return False
