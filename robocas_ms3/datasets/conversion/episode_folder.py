"""Writer of episode folders: images are written while they are rendered, other files at the end."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import encode_json
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.images import check_cameras, check_images
from robocas_ms3.datasets.checks.violation import read_json_object
from robocas_ms3.datasets.conversion.workers import EpisodeWriter, InputEpisode
from robocas_ms3.datasets.images.image_files import ImageOptions, write_image
from robocas_ms3.datasets.images.image_headers import check_file_ends
from robocas_ms3.datasets.images.preview_frames import EpisodeDrawer
from robocas_ms3.datasets.images.video import open_preview
from robocas_ms3.datasets.sources.arrays import add_embeddings, read_arrays
from robocas_ms3.datasets.sources.episode_source import StepImages
from robocas_ms3.robots.camera_models import CameraModel

ENCODERS = 2  # threads; libdeflate and OpenCV release the GIL
_MAX_WAITING = 24  # images, to bound memory


@dataclass(frozen=True)
class FolderWriter(EpisodeWriter):
    """Writes the episodes of a RoboCAS folder.

    Attributes:
        out: folder of the dataset.
        embed: function that returns the embeddings (N, 384) of N texts; None: no embeddings are written.
        sheet: numbers of the episodes on the contact sheet; None: no previews are written.
    """

    out: Path
    embed: Callable[[list[str]], NDArray[np.float32]] | None = None
    sheet: tuple[int, ...] | None = None

    def folder(self, number: int) -> Path:
        return self.out / schema.episode_folder(number)

    def write_files(
        self, folder: Path, episode: InputEpisode, frames: Generator[StepImages, None, None]
    ) -> NDArray[np.uint8] | None:
        image_options, arrays, preview = episode.conversion_input.image_options, episode.arrays, None
        for camera in image_options.cameras:
            for kind in image_options.kinds:
                (folder / camera / kind).mkdir(parents=True)
        with ExitStack() as stack:
            if self.sheet is not None:
                drawing = EpisodeDrawer(episode.number, arrays, episode.conversion_input.source.rate_hz)
                preview = stack.enter_context(open_preview(self.out, drawing, row=episode.number in self.sheet))
            encode = stack.enter_context(_open_encoder())
            in_order = stack.enter_context(_open_encoder(1))  # frames of a video
            for step, frame in enumerate(frames):
                for kind in image_options.kinds:
                    images = frame.rgb if kind == "rgb" else frame.depth
                    for camera in image_options.cameras:
                        path = schema.image_path(folder, camera, kind, step, image_options.image_format)
                        encode(write_image, path, images[camera])
                if preview:
                    in_order(preview.add_step, step, frame.rgb)
        cameras = {name: episode.source_episode.camera(name) for name in image_options.cameras}
        arrays = add_embeddings(arrays, self.embed) if self.embed else arrays
        write_episode_files(folder, arrays, cameras, episode.source_episode.scene)
        return preview and preview.row


def write_episode_files(
    folder: Path, arrays: dict[str, NDArray], cameras: Mapping[str, CameraModel], scene: Mapping[str, Any]
) -> None:
    """Write the arrays, camera files and ``scene.json`` of an episode."""
    for camera, model in cameras.items():
        np.save(folder / camera / schema.INTRINSIC_FILE, model.intrinsic)
        for name in schema.pose_files(model.parent):
            np.save(folder / camera / name, model.camera_in_parent)
        np.save(folder / camera / schema.true_pose_file(model.parent), model.true_camera_in_parent)
    np.savez(folder / schema.EPISODE_FILE, **arrays)  # pyright: ignore[reportArgumentType]
    text = encode_json(dict(scene), folder, indent=1, error=DatasetError)
    (folder / schema.SCENE_FILE).write_text(text + "\n", encoding="utf-8")


@contextmanager
def _open_encoder(threads: int = ENCODERS) -> Generator[Callable[..., None], None, None]:
    """Yield a function that runs a call in a thread; the function blocks while too many calls are waiting."""
    waiting: deque[Future[Any]] = deque()

    def collect(limit: int) -> None:
        while len(waiting) > limit:
            waiting.popleft().result()

    def submit(*call: Any) -> None:
        waiting.append(pool.submit(*call))
        collect(_MAX_WAITING)

    pool = ThreadPoolExecutor(threads)
    try:
        yield submit
        collect(0)
    finally:
        pool.shutdown(cancel_futures=True)


def find_damaged_file(folder: Path, image_options: ImageOptions) -> Path | None:
    """Return the first missing or truncated file of an episode, None if all are complete."""
    steps = read_arrays(folder / schema.EPISODE_FILE, ("episode_length",)).arrays.get("episode_length")
    if steps is None or steps.ndim:
        return folder / schema.EPISODE_FILE
    root = folder.parent
    for wrong in (
        *read_json_object(root, f"{folder.name}/{schema.SCENE_FILE}")[1],
        *check_cameras(folder, image_options),
        *check_images(folder, image_options, int(steps), {}, check_file_ends),
    ):
        if wrong.kind != "unexpected" and not (root / wrong.file).is_dir():  # folder of an unexpected camera
            return root / wrong.file
    return None
