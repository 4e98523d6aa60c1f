"""``robocas merge``: join datasets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from robocas_ms3.cli.options import Folders


@dataclass
class Merge:
    """Join datasets into one. Episodes are numbered in the given order and keep their side of the split.

    Example: robocas merge datasets/pick datasets/search --out datasets/both
    """

    datasets: Folders
    """Folders of datasets with the same settings."""
    out: Path
    """Folder of the new dataset."""
    skip_duplicates: bool = False
    """Keep one copy of a recording that is in several datasets, instead of an error."""
    copy: bool = False
    """Copy files instead of hard-linking them."""
    overwrite: bool = False
    """Start again. Default: continue a merge of the same inputs that was interrupted."""


def main(cfg: Merge) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.datasets.manage.copy_episodes import CopyOptions
    from robocas_ms3.datasets.manage.merge import merge

    with ProgressBar("episodes written") as bar:
        options = CopyOptions(not cfg.copy, cfg.overwrite, bar.start, bar.advance)
        done = merge(cfg.datasets, cfg.out, skip_duplicates=cfg.skip_duplicates, options=options)
    print_line(str(done))
    return 0
