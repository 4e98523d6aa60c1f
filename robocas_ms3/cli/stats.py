"""``robocas stats``: write statistics of a dataset."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from robocas_ms3.cli.options import Maybe
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.text import format_count


@dataclass
class Stats:
    """Write statistics of a dataset, a trajectory file or a candidates.h5 as plots and JSON.

    The statistics cover lengths, objects, layouts, instructions, actions and sub-goals. Those of candidates.h5 cover
    outcomes, benefits, choices and failures; a table is printed.

    Several files of candidates are counted together; give --out for their plots.

    Example: robocas stats datasets/pick
    """

    path: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset or of robocas generate, a trajectory.h5, or a candidates.h5.
    Failed episodes of a trajectory.h5 are included."""
    others: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[PATH ...]", help_behavior_hint="")
    ] = ()
    """Further files candidates.h5."""
    out: Maybe[Path] = None
    """Output folder. Default: DATASET/preview/stats, or NAME_stats next to a file NAME.h5; none for several files."""
    json: bool = False
    """Print the statistics as JSON; files are written only with --out."""
    rate: Maybe[float] = None
    """Sampling rate of a trajectory in Hz. Default: 5."""


def main(cfg: Stats) -> int:
    from robocas_ms3.cli.terminal import print_json, print_line
    from robocas_ms3.datasets.formats import CANDIDATES, detect_format
    from robocas_ms3.demos.settings import find_trajectory

    cfg = replace(cfg, path=find_trajectory(cfg.path))
    found = detect_format(cfg.path)
    has_candidates = found is not None and found.name == CANDIDATES
    if cfg.others and not has_candidates:
        raise RobocasError(
            "only statistics of files candidates.h5 can be computed together",
            where=cfg.path,
            fix="Give one dataset, or merge datasets with robocas merge.",
            usage=True,
        )
    out = cfg.out or (None if cfg.json or cfg.others else _default_folder(cfg.path))
    write_statistics = _write_candidate_statistics if has_candidates else _write_statistics
    content, summary, images = write_statistics(cfg, out)
    if cfg.json:
        print_json(content)
    else:
        written = f"; {out}: stats.json and {format_count(images, 'image')}" if out else ""
        where = f"{1 + len(cfg.others)} files" if cfg.others else cfg.path
        print_line(f"{where}: {summary}{written}")
    return 0


def _default_folder(path: Path) -> Path:
    from robocas_ms3.datasets.schema import PREVIEW_FOLDER

    return path / PREVIEW_FOLDER / "stats" if path.is_dir() else path.with_name(f"{path.stem}_stats")


def _write_statistics(cfg: Stats, out: Path | None) -> tuple[dict[str, Any], str, int]:
    """Write the statistics of a dataset; return the content of the JSON, a summary and the number of images."""
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.datasets.statistics.collect import collect_statistics
    from robocas_ms3.datasets.statistics.plots import write_stats

    with ProgressBar("episodes read") as bar:
        stats = collect_statistics(cfg.path, rate_hz=cfg.rate, on_episode=bar.update)
    paths = write_stats(stats, out) if out else []
    return stats.as_json(), stats.summary(), len(paths) - 1


def _write_candidate_statistics(cfg: Stats, out: Path | None) -> tuple[dict[str, Any], str, int]:
    from robocas_ms3.cli.terminal import print_table
    from robocas_ms3.datasets.statistics.candidate_plots import write_candidate_stats
    from robocas_ms3.datasets.statistics.candidates import COLUMNS, compute_candidate_statistics

    stats = compute_candidate_statistics([cfg.path, *cfg.others])
    if not cfg.json:
        print_table(COLUMNS, stats.rows())
        print_table(("decision", "best chosen", "mean regret s"), stats.choice_rows())
    paths = write_candidate_stats(stats, out) if out else []
    return stats.as_json(), stats.summary(), len(paths) - 1
