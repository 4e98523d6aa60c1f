"""``robocas stats``: write statistics of a dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from robocas_ms3.cli.options import Maybe
from robocas_ms3.core.text import format_count


@dataclass
class Stats:
    """Write statistics of a dataset or a trajectory file as plots and JSON.

    The statistics cover lengths, objects, layouts, instructions, actions and sub-goals.

    Example: robocas stats datasets/pick
    """

    path: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset, or a trajectory.h5. Failed episodes of a trajectory.h5 are included."""
    out: Maybe[Path] = None
    """Output folder. Default: DATASET/preview/stats, or TRAJECTORY_stats next to a trajectory."""
    json: bool = False
    """Print the statistics as JSON; files are written only with --out."""
    rate: Maybe[float] = None
    """Sampling rate of a trajectory in Hz. Default: 5."""


def main(cfg: Stats) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_json, print_line
    from robocas_ms3.datasets.schema import PREVIEW_FOLDER
    from robocas_ms3.datasets.statistics.collect import collect_statistics
    from robocas_ms3.datasets.statistics.plots import write_stats

    with ProgressBar("episodes read") as bar:
        stats = collect_statistics(cfg.path, rate_hz=cfg.rate, on_episode=bar.update)
    default = cfg.path / PREVIEW_FOLDER / "stats" if cfg.path.is_dir() else cfg.path.with_name(f"{cfg.path.stem}_stats")
    out = cfg.out or (None if cfg.json else default)
    paths = write_stats(stats, out) if out else []
    if cfg.json:
        print_json(stats.as_json())
        return 0
    images = len(paths) - 1
    print_line(f"{cfg.path}: {stats.summary()}; {out}: stats.json and {format_count(images, 'image')}")
    return 0
