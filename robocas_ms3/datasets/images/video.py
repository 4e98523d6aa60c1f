"""Videos and contact sheets, from the stored images of a dataset or during a conversion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import cv2
import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import atomic_file, make_folder
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.images.png import encode_png
from robocas_ms3.datasets.images.preview_frames import EpisodeDrawer, Images
from robocas_ms3.datasets.sources.episode_source import EpisodeSource, ImageKind, iter_images

PANEL, PREVIEW_PANEL = (426, 320), (320, 240)
"""Width and height of the image of a camera in a video and in a preview, pixels."""
SHEET_EPISODES = 10
"""Number of episodes on a contact sheet."""
MAX_PREVIEWS = 20
"""Largest number of episodes that get previews by default."""
_NEAR_MM, _FAR_MM = 30, 5000  # range of the colour map of depth
# The default preset of x264 takes three times as long; more threads slow the renderer down.
_PREVIEW_OPTIONS = ("-preset", "veryfast", "-threads", "1")


@contextmanager
def open_video(path: Path, fps: float, *options: str, quality: float = 8) -> Iterator[Any]:
    """Open a writer of an MP4 video (H.264, yuv420p); its ``append_data`` takes frames (H, W, 3) RGB.

    H and W must be even. ``options``: options of FFmpeg. ``quality``: 0 (worst) to 10 (best).
    """
    writer = imageio.get_writer(
        path,
        fps=fps,
        codec="libx264",
        pixelformat="yuv420p",
        quality=quality,
        macro_block_size=2,
        ffmpeg_log_level="error",
        output_params=list(options),
    )
    with closing(writer):  # its own `with` leaves FFmpeg running after an error
        yield writer


def write_video(
    dataset: EpisodeSource, number: int, path: Path | str, *, speed: float = 1.0, kind: ImageKind = "rgb"
) -> Path:
    """Write the video of an episode as MP4 (H.264) and return its path.

    All cameras are next to each other, with texts below. ``speed`` 1 is real time. Depth images are shown in colours.

    Raises:
        DatasetError: the episode does not exist, or the speed is invalid.
    """
    if not 0 < speed < np.inf:
        raise DatasetError("invalid speed", where="speed", expected="> 0", found=speed)
    path = Path(path)
    episode = dataset.episode(number)
    drawing = EpisodeDrawer(number, episode.arrays, dataset.rate_hz)
    with (
        atomic_file(path) as tmp,
        open_video(tmp, dataset.rate_hz * speed) as video,
        closing(iter_images(episode, episode.cameras, kind)) as run,
    ):
        for step, images in enumerate(run):
            video.append_data(drawing.draw_frame(step, _colour_images(images, kind), PANEL))
    return path


def write_contact_sheet(
    dataset: EpisodeSource, out: Path | str, *, episodes: Sequence[int] | None = None, kind: ImageKind = "rgb"
) -> Path:
    """Write a contact sheet of episodes as PNG and return its path.

    It has the images of evenly spaced steps, for each episode and camera. ``episodes``: episode numbers; default: the
    first ten.
    """
    numbers = dataset.numbers[:SHEET_EPISODES] if episodes is None else list(episodes)
    return _write_sheet([_draw_stored_row(dataset, number, kind) for number in numbers], out)


class Preview:
    """Writes the video of an episode during its conversion, and draws its contact sheet row."""

    def __init__(self, video: Any, drawing: EpisodeDrawer, *, row: bool) -> None:
        self.row: NDArray[np.uint8] | None = None
        """Row of the contact sheet, (H, W, 3) RGB; set after the last frame, if requested."""
        self._video, self._drawing, self._wanted = video, drawing, drawing.row_steps if row else []
        self._shown: dict[int, Images] = {}

    def add_step(self, step: int, rgb: Images) -> None:
        """Append the RGB images of the next step to the video."""
        self._video.append_data(self._drawing.draw_frame(step, rgb, PREVIEW_PANEL))
        if step in self._wanted:
            self._shown[step] = rgb
            if step == self._wanted[-1]:
                self.row, self._shown = self._drawing.draw_row(self._shown), {}


@contextmanager
def open_preview(root: Path, drawing: EpisodeDrawer, *, row: bool) -> Iterator[Preview]:
    """Open the preview of an episode; ``row``: whether it also draws the contact sheet row."""
    path = make_folder(root / schema.PREVIEW_FOLDER) / f"{schema.episode_folder(drawing.number)}.mp4"
    with atomic_file(path) as tmp, open_video(tmp, drawing.rate_hz, *_PREVIEW_OPTIONS, quality=6) as video:
        yield Preview(video, drawing, row=row)


def select_sheet_episodes(numbers: Iterable[int]) -> tuple[int, ...]:
    """Return the numbers of the episodes on the contact sheet: the first ten."""
    return tuple(sorted(numbers)[:SHEET_EPISODES])


def complete_contact_sheet(dataset: EpisodeSource, rows: dict[int, NDArray[np.uint8]]) -> None:
    """Write the contact sheet of a dataset.

    ``rows``: rows of newly written episodes, by number. The other rows are drawn from stored images.
    """
    path = dataset.root / schema.PREVIEW_FOLDER / "contact_sheet.png"
    if rows or not path.is_file():
        numbers = select_sheet_episodes(dataset.numbers)
        _write_sheet(
            [rows[number] if number in rows else _draw_stored_row(dataset, number) for number in numbers], path
        )


def _draw_stored_row(dataset: EpisodeSource, number: int, kind: ImageKind = "rgb") -> NDArray[np.uint8]:
    episode, shown = dataset.episode(number), {}
    drawing = EpisodeDrawer(number, episode.arrays, dataset.rate_hz)
    image = episode.rgb if kind == "rgb" else episode.depth
    for step in drawing.row_steps:
        shown[step] = _colour_images({camera: image(camera, step) for camera in episode.cameras}, kind)
    return drawing.draw_row(shown)


def _write_sheet(rows: Sequence[NDArray[np.uint8]], path: Path | str) -> Path:
    with atomic_file(path) as tmp:
        tmp.write_bytes(encode_png(np.concatenate(rows)))
    return Path(path)


def colour_depth(depth: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Convert depth (H, W) in mm to colours (H, W, 3) RGB.

    The scale is logarithmic, from red (near) to blue (far). Pixels without depth are black.
    """
    near, far = np.log(_NEAR_MM), np.log(_FAR_MM)
    fraction = np.clip((far - np.log(np.maximum(depth, 1))) / (far - near), 0, 1)
    colours = cv2.applyColorMap((fraction * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    colours[depth == 0] = 0
    return colours.astype(np.uint8)


def _colour_images(images: Mapping[str, NDArray], kind: ImageKind) -> Images:
    return {camera: image if kind == "rgb" else colour_depth(image) for camera, image in images.items()}
