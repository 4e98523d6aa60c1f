"""``robocas merge``: merge several datasets into one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from robocas_ms3.cli.options import Folders


@dataclass
class Merge:
    """Merge several datasets into one dataset.

    Episodes are numbered from 0 in the order of the folders, and keep their split (training or validation).

    Example: robocas merge datasets/pick datasets/search --out datasets/both
    """

    datasets: Folders
    """Folders of the datasets.
    Rate, cameras, image size and format, depth, embeddings and schema version must be equal."""
    out: Path
    """Folder of the new dataset."""
    skip_duplicates: bool = False
    """Keep only the first copy of an episode that is in several datasets. Default: stop with an error."""
    copy: bool = False
    """Copy files instead of hard-linking them."""
    overwrite: bool = False
    """Start again. Default: continue an interrupted merge of the same inputs."""


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
