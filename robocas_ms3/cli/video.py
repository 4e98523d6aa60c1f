"""``robocas video``: write videos and a contact sheet of a dataset."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from robocas_ms3.cli.options import Maybe, Several
from robocas_ms3.core.errors import DatasetError


@dataclass
class Video:
    """Write a video per episode and a contact sheet of a dataset.

    Example: robocas video datasets/pick --episodes 0 3 --kind depth
    """

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset."""
    out: Maybe[Path] = None
    """Output folder. Default: DATASET/preview."""
    episodes: Several[int] = ()
    """Episode numbers. Default: all; the contact sheet shows the first ten."""
    kind: Literal["rgb", "depth"] = "rgb"
    """Images of the video; the video shows depth as colours."""
    speed: float = 1.0
    """Playback speed as a multiple of real time."""


def main(cfg: Video) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.datasets.formats import open_source
    from robocas_ms3.datasets.images.video import write_contact_sheet, write_video
    from robocas_ms3.datasets.schema import PREVIEW_FOLDER, episode_folder

    if not 0 < cfg.speed < math.inf:
        raise DatasetError("invalid playback speed", where="--speed", expected="a finite number > 0", found=cfg.speed)
    dataset = open_source(cfg.dataset)
    out = cfg.out or cfg.dataset / PREVIEW_FOLDER
    numbers = list(cfg.episodes) or dataset.numbers
    for number in numbers:  # before anything is written
        dataset.episode(number)
    suffix = "" if cfg.kind == "rgb" else f"_{cfg.kind}"
    with ProgressBar("videos written") as bar:
        bar.start(len(numbers))
        for number in numbers:
            path = out / f"{episode_folder(number)}{suffix}.mp4"
            print_line(str(write_video(dataset, number, path, speed=cfg.speed, kind=cfg.kind)))
            bar.advance()
    sheet = out / f"contact_sheet{suffix}.png"
    print_line(str(write_contact_sheet(dataset, sheet, episodes=cfg.episodes or None, kind=cfg.kind)))
    return 0
