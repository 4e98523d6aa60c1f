"""Videos and contact sheets of a dataset, for people to look at."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import cv2
import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.reader import Dataset, Episode
from robocas_ms3.errors import DatasetError
from robocas_ms3.files import make_folder, replacing

PANEL = (426, 320)
"""Width and height of one camera's picture in a video."""
_BAND = 64  # height of the text below the pictures
_INK, _FAINT, _PAPER = (245, 245, 245), (170, 180, 190), (24, 26, 30)
_NEAR_MM, _FAR_MM = 30, 5000  # colours of depth


def write_video(
    dataset: Dataset, number: int, path: Path | str, *, speed: float = 1.0, kind: str = "rgb", panel=PANEL
) -> Path:
    """Write an episode as MP4 (H.264, yuv420p): the cameras side by side, instruction and sub-goal below.

    Args:
        dataset: the dataset.
        number: of the episode.
        path: of the video.
        speed: 1 is real time.
        kind: ``rgb``, or ``depth`` in colours.
        panel: width and height of one camera's picture.

    Raises:
        DatasetError: no such episode, or no such speed.
    """
    if not 0 < speed < np.inf:
        raise DatasetError("no such speed", where="speed", expected="> 0", found=speed)
    path = Path(path)
    episode = dataset.episode(number)
    with (
        replacing(path) as tmp,
        imageio.get_writer(
            tmp,
            fps=dataset.rate_hz * speed,
            codec="libx264",
            pixelformat="yuv420p",
            quality=8,
            macro_block_size=2,
            ffmpeg_log_level="error",
        ) as video,
    ):
        writer: Any = video
        for step in range(episode.steps):
            writer.append_data(video_frame(episode, step, number=number, kind=kind, panel=panel))
    return path


def video_frame(
    episode: Episode, step: int, *, number: int = 0, kind: str = "rgb", panel: tuple[int, int] = PANEL
) -> NDArray[np.uint8]:
    """One picture of the video, (H, W, 3) RGB, both even."""
    width, height = panel
    canvas = Image.new("RGB", (width * len(episode.cameras), height + _BAND), _PAPER)
    draw = ImageDraw.Draw(canvas)
    for index, camera in enumerate(episode.cameras):
        canvas.paste(_fit(_picture(episode, camera, step, kind), panel), (index * width, 0))
        _label(draw, (index * width + 6, 5), camera.replace("_", " "), 14)
    arrays = episode.arrays
    state = "open" if arrays["gripper_status"][step] else "closed"
    clock = f"episode {number}   step {step} / {episode.steps - 1}   gripper {state}"
    _text(draw, (10, height + 7), str(arrays["language_goal"]), 20, _INK, canvas.width - 20)
    goal = f"{arrays['step_goal_type'][step]}: {arrays['step_lang_goals'][step]}"
    clock_width = round(draw.textlength(clock, _font(16)))
    _text(draw, (10, height + 37), goal, 16, _FAINT, canvas.width - clock_width - 40)
    draw.text((canvas.width - clock_width - 10, height + 37), clock, _FAINT, _font(16))
    return np.asarray(canvas)


def contact_sheet(
    root: Path | str,
    out: Path | str,
    *,
    episodes: Sequence[int] | None = None,
    columns: int = 8,
    thumbnail: tuple[int, int] = (213, 160),
    kind: str = "rgb",
) -> Path:
    """Write a PNG with a row for each episode and camera, of evenly spaced steps from first to last.

    Args:
        root: the dataset.
        out: path of the PNG.
        episodes: numbers; None: the first ten.
        columns: pictures a row.
        thumbnail: width and height of a picture.
        kind: ``rgb``, or ``depth`` in colours.
    """
    dataset = Dataset(Path(root))
    numbers = dataset.numbers[:10] if episodes is None else list(episodes)
    width, height = thumbnail
    cameras = dataset.episode(numbers[0]).cameras if numbers else ()
    left, caption, gap = 110, 30, 3
    block = caption + len(cameras) * (height + gap) + 10
    sheet = Image.new("RGB", (left + columns * (width + gap), block * len(numbers)), _PAPER)
    draw = ImageDraw.Draw(sheet)
    for row, number in enumerate(numbers):
        episode = dataset.episode(number)
        top = row * block
        _text(draw, (8, top + 6), f"{number}   {episode.arrays['language_goal']}", 18, _INK, sheet.width - 16)
        for index, camera in enumerate(cameras):
            y = top + caption + index * (height + gap)
            for line, word in enumerate(camera.split("_")):
                draw.text((8, y + 6 + 20 * line), word, _FAINT, _font(16))
            for column, step in enumerate(np.linspace(0, episode.steps - 1, columns).round().astype(int)):
                x = left + column * (width + gap)
                sheet.paste(_fit(_picture(episode, camera, int(step), kind), thumbnail), (x, y))
                if index == 0:
                    _label(draw, (x + 5, y + 4), f"{step / dataset.rate_hz:.1f} s", 13)
                if index == len(cameras) - 1:
                    _label(draw, (x + 5, y + height - 22), str(episode.arrays["step_goal_type"][step]), 13)
    out = Path(out)
    with replacing(out) as tmp:
        sheet.save(tmp)
    return out


def write_previews(
    root: Path | str,
    *,
    new: Collection[int] = (),
    episodes: Sequence[int] | None = None,
    on_start: Callable[[int], None] | None = None,
    on_video: Callable[[Path], None] | None = None,
) -> tuple[list[Path], Path]:
    """Write videos of episodes and a contact sheet into the dataset's ``preview`` folder; gives their paths.

    Args:
        root: the dataset.
        new: episodes that were not there before.
        episodes: of which; None: videos of the new ones and of those that have none, the sheet of the first ten.
        on_start: called with the number of videos to write.
        on_video: called after each.
    """
    dataset = Dataset(Path(root))
    folder = make_folder(dataset.root / schema.PREVIEW_FOLDER)
    chosen = dataset.numbers if episodes is None else episodes
    paths = {number: folder / f"{schema.episode_folder(number)}.mp4" for number in chosen}
    if episodes is None:
        paths = {number: path for number, path in paths.items() if number in new or not path.is_file()}
    if on_start:
        on_start(len(paths))
    for number, path in paths.items():
        write_video(dataset, number, path)
        if on_video:
            on_video(path)
    return list(paths.values()), contact_sheet(root, folder / "contact_sheet.png", episodes=episodes)


def colour_depth(depth: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Depth as colours, (H, W, 3) RGB, on a logarithmic scale: near is red, far is blue, nothing is black."""
    near, far = np.log(_NEAR_MM), np.log(_FAR_MM)
    share = np.clip((far - np.log(np.maximum(depth, 1))) / (far - near), 0, 1)
    colours = cv2.applyColorMap((share * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    colours[depth == 0] = 0
    return colours.astype(np.uint8)


def _picture(episode: Episode, camera: str, step: int, kind: str) -> NDArray[np.uint8]:
    return episode.rgb(camera, step) if kind == "rgb" else colour_depth(episode.depth(camera, step))


def _fit(picture: NDArray[np.uint8], size: tuple[int, int]) -> Image.Image:
    return Image.fromarray(picture).resize(size, Image.Resampling.BOX if picture.shape[1] > size[0] else 0)


def _font(size: int) -> Any:
    return ImageFont.load_default(size)  # Pillow's own scalable font: no file needed


def _text(draw: ImageDraw.ImageDraw, at: tuple[int, int], text: str, size: int, ink, width: int) -> None:
    """Write one line, smaller where it is too long."""
    while size > 10 and draw.textlength(text, _font(size)) > width:
        size -= 1
    draw.text(at, text, ink, _font(size))


def _label(draw: ImageDraw.ImageDraw, at: tuple[int, int], text: str, size: int) -> None:
    """Write on a picture: light with a dark rim."""
    draw.text(at, text, _INK, _font(size), stroke_width=2, stroke_fill=(0, 0, 0))
