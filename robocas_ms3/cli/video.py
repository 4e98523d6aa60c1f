"""``robocas video``: write videos of a dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from robocas_ms3.cli.options import Maybe, Several


@dataclass
class Video:
    """Write videos and a contact sheet of a dataset.

    Example: robocas video datasets/pick --episodes 0 3 --kind depth
    """

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset."""
    out: Maybe[Path] = None
    """Folder to write to; Default: DATASET/preview."""
    episodes: Several[int] = ()
    """Numbers of the episodes. Default: all."""
    kind: Literal["rgb", "depth"] = "rgb"
    """Images to show; depth is shown in colours."""
    speed: float = 1.0
    """Playback speed; 1: real time."""


def main(cfg: Video) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.datasets.formats import open_source
    from robocas_ms3.datasets.images.video import contact_sheet, write_video
    from robocas_ms3.datasets.schema import PREVIEW_FOLDER, episode_folder

    dataset = open_source(cfg.dataset)
    out = cfg.out or cfg.dataset / PREVIEW_FOLDER
    numbers = list(cfg.episodes) or dataset.numbers
    for number in numbers:  # before anything is written
        dataset.episode(number)
    suffix = "" if cfg.kind == "rgb" else f"_{cfg.kind}"
    with ProgressBar("episodes filmed") as bar:
        bar.start(len(numbers))
        for number in numbers:
            path = out / f"{episode_folder(number)}{suffix}.mp4"
            print_line(str(write_video(dataset, number, path, speed=cfg.speed, kind=cfg.kind)))
            bar.advance()
    sheet = out / f"contact_sheet{suffix}.png"
    print_line(str(contact_sheet(dataset, sheet, episodes=cfg.episodes or None, kind=cfg.kind)))
    return 0
