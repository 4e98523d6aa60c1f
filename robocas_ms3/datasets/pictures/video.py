"""Videos and contact sheets of a dataset, for people to look at; drawn of its pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import replacing
from robocas_ms3.datasets.pictures.drawing import (
    Pictures,
    Story,
    draw_frame,
    draw_row,
    row_steps,
)
from robocas_ms3.datasets.pictures.png import encode_png
from robocas_ms3.datasets.sources.protocol import EpisodeSource, Kind, shots

PANEL = (426, 320)
"""Width and height of one camera's picture in a video."""
SHEET = 10
"""Episodes on a contact sheet."""
_NEAR_MM, _FAR_MM = 30, 5000  # colours of depth


def open_video(path: Path, fps: float, *options: str, quality: float = 8) -> Any:
    """Open an MP4 (H.264, yuv420p) to append (H, W, 3) RGB to, H and W even; close it, or use ``with``.

    Args:
        path: of the video.
        fps: frames a second.
        options: FFmpeg's, for the output.
        quality: 0 to 10.
    """
    return imageio.get_writer(
        path,
        fps=fps,
        codec="libx264",
        pixelformat="yuv420p",
        quality=quality,
        macro_block_size=2,
        ffmpeg_log_level="error",
        output_params=list(options),
    )


def write_video(
    dataset: EpisodeSource,
    number: int,
    path: Path | str,
    *,
    speed: float = 1.0,
    kind: Kind = "rgb",
) -> Path:
    """Write an episode as MP4 (H.264, yuv420p): the cameras side by side, instruction and sub-goal below.

    Args:
        dataset: the dataset.
        number: of the episode.
        path: of the video.
        speed: 1 is real time.
        kind: ``rgb``, or ``depth`` in colours.

    Raises:
        DatasetError: no such episode, or no such speed.
    """
    if not 0 < speed < np.inf:
        raise DatasetError("no such speed", where="speed", expected="> 0", found=speed)
    path = Path(path)
    episode = dataset.episode(number)
    story = Story.of(number, episode.arrays)
    with (
        replacing(path) as tmp,
        open_video(tmp, dataset.rate_hz * speed) as video,
        closing(shots(episode, episode.cameras, kind)) as run,
    ):
        for step, pictures in enumerate(run):
            video.append_data(draw_frame(story, step, _coloured(pictures, kind), PANEL))
    return path


def contact_sheet(
    dataset: EpisodeSource, out: Path | str, *, episodes: Sequence[int] | None = None, kind: Kind = "rgb"
) -> Path:
    """Write a PNG with a row for each episode and camera, of evenly spaced steps from first to last.

    Args:
        dataset: the dataset.
        out: path of the PNG.
        episodes: numbers; None: the first ten.
        kind: ``rgb``, or ``depth`` in colours.
    """
    numbers = dataset.numbers[:SHEET] if episodes is None else list(episodes)
    return write_sheet([sheet_row(dataset, number, kind) for number in numbers], out)


def sheet_row(dataset: EpisodeSource, number: int, kind: Kind = "rgb") -> NDArray[np.uint8]:
    """Return an episode's part of a contact sheet, (H, W, 3) RGB."""
    episode, shown = dataset.episode(number), {}
    picture = episode.rgb if kind == "rgb" else episode.depth
    for step in row_steps(episode.steps):
        shown[step] = _coloured({camera: picture(camera, step) for camera in episode.cameras}, kind)
    return draw_row(Story.of(number, episode.arrays), shown, dataset.rate_hz)


def write_sheet(rows: Sequence[NDArray[np.uint8]], path: Path | str) -> Path:
    """Write a contact sheet as PNG."""
    with replacing(path) as tmp:
        tmp.write_bytes(encode_png(np.concatenate(rows)))
    return Path(path)


def colour_depth(depth: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Depth as colours, (H, W, 3) RGB, on a logarithmic scale: near is red, far is blue, nothing is black."""
    near, far = np.log(_NEAR_MM), np.log(_FAR_MM)
    share = np.clip((far - np.log(np.maximum(depth, 1))) / (far - near), 0, 1)
    colours = cv2.applyColorMap((share * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    colours[depth == 0] = 0
    return colours.astype(np.uint8)


def _coloured(pictures: Mapping[str, NDArray], kind: Kind) -> Pictures:
    """Depth as colours, RGB as it is."""
    return {camera: picture if kind == "rgb" else colour_depth(picture) for camera, picture in pictures.items()}
