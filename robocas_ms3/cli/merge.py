"""``robocas merge``: write one dataset of several."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass
class Merge:
    """Write a dataset of all episodes of others, in the order given, numbered anew; the split stays as it was."""

    datasets: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="PATH [PATH ...]", help_behavior_hint="(required)"),  # tyro takes none, too: see `merge`
    ]
    """Folders of datasets of the same settings."""
    out: Path
    """Folder of the new dataset."""
    skip_duplicates: bool = False
    """Take a recording that is there several times once, instead of refusing."""
    copy: bool = False
    """Copy files, also where hard links would do."""
    overwrite: bool = False
    """Replace the dataset that is there."""
    resume: bool = False
    """Go on with a merge that was interrupted."""


def main(cfg: Merge) -> int:
    """Merge, with a progress bar; gives the exit code."""
    from robocas_ms3.cli.bars import bar
    from robocas_ms3.cli.terminal import say
    from robocas_ms3.core.words import count_of
    from robocas_ms3.datasets.manage.merging import merge

    with bar("episodes written") as shown:
        done = merge(
            cfg.datasets,
            cfg.out,
            skip_duplicates=cfg.skip_duplicates,
            link=not cfg.copy,
            overwrite=cfg.overwrite,
            resume=cfg.resume,
            on_start=shown.start,
            on_episode=shown.advance,
        )
    skipped = f", {count_of(done.skipped, 'duplicate')} left out" if done.skipped else ""
    say(f"{done.written}{skipped}")
    return 0
