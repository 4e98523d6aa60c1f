"""``robocas stats``: count what is in a dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from robocas_ms3.cli.options import Maybe
from robocas_ms3.core.words import count_of


@dataclass
class Stats:
    """Count what is in a dataset: lengths, objects, layouts, instructions, actions, sub-goals. Pictures and JSON."""

    path: Annotated[Path, tyro.conf.Positional]
    """Folder of a RoboCAS dataset, or trajectory.h5 (its failed episodes too)."""
    out: Maybe[Path] = None
    """Folder to write to; default: DATASET/preview/stats, or TRAJECTORY_stats beside a trajectory."""
    json: bool = False
    """Print the JSON; files are written only if --out says where."""
    rate: Maybe[float] = None
    """Steps a second of a trajectory; default 5. A dataset has its own."""


def main(cfg: Stats) -> int:
    """Count and draw; gives the exit code."""
    import json

    from robocas_ms3.cli.bars import bar
    from robocas_ms3.cli.terminal import say, say_lines
    from robocas_ms3.datasets.schema import PREVIEW_FOLDER
    from robocas_ms3.datasets.statistics.collect import collect
    from robocas_ms3.datasets.statistics.plots import write_stats

    with bar("episodes read") as shown:
        stats = collect(cfg.path, rate_hz=cfg.rate, on_episode=shown.at)
    default = cfg.path / PREVIEW_FOLDER / "stats" if cfg.path.is_dir() else cfg.path.with_name(f"{cfg.path.stem}_stats")
    out = cfg.out or (None if cfg.json else default)
    paths = write_stats(stats, out) if out else []
    if cfg.json:
        say_lines(json.dumps(stats.as_json(), indent=2, ensure_ascii=False))
        return 0
    pictures = len(paths) - 1
    say(f"{cfg.path}: {stats.summary()}; {out}: stats.json and {count_of(pictures, 'picture')}")
    return 0
