"""``robocas split``: write several datasets of one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from robocas_ms3.cli.options import Maybe, Several


@dataclass
class Split:
    """Split a dataset into several, or choose its training and validation episodes again.

    - --out-train T --out-val V: training and validation episodes as two datasets
    - --parts 0.8 0.2 --out O: datasets O/part_0, O/part_1, ... with these fractions
    - --by task --out O: one dataset per task (or target)
    - --in-place --val-share 0.2: write only data_info.json; without --val-share, rebuild it from the episodes on disk

    Example: robocas split datasets/pick --out-train datasets/train --out-val datasets/val
    """

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset."""
    out_train: Maybe[Path] = None
    """Folder of the training episodes."""
    out_val: Maybe[Path] = None
    """Folder of the validation episodes."""
    parts: Several[float] = ()
    """Fractions of the parts; they sum to 1."""
    out: Maybe[Path] = None
    """Folder for the folders of the parts."""
    in_place: bool = False
    """Write only data_info.json."""
    val_share: Maybe[float] = None
    """Choose training and validation again, with this fraction for validation. Default: each episode keeps its side."""
    by: Maybe[Literal["seed", "target", "task"]] = None
    """Episodes that stay together: of one seed (default), target object or task."""
    copy: bool = False
    """Copy files instead of hard-linking them."""
    overwrite: bool = False
    """Start again. Default: continue a split of the same inputs that was interrupted."""


def main(cfg: Split) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.text import format_count
    from robocas_ms3.datasets.manage import split
    from robocas_ms3.datasets.manage.copy_episodes import CopyOptions, open_finished

    _check(cfg)
    by = cfg.by or "seed"
    whole = cfg.out is not None and not cfg.parts  # each part is one task or target, which can't be cut by itself
    share = None if cfg.val_share is None else split.Share(cfg.val_share, "seed" if whole else by)
    if cfg.in_place:
        train, val = split.resplit(cfg.dataset, share)
        print_line(f"{cfg.dataset}: {format_count(len(train), 'episode')} for training, {len(val)} for validation")
        return 0
    source = open_finished(cfg.dataset)
    if cfg.out_train and cfg.out_val:
        pieces = split.split_by_side(source, share, cfg.out_train, cfg.out_val)
    else:
        assert cfg.out is not None
        named = (
            split.split_by_fractions(source.dataset, cfg.parts, by, share)
            if cfg.parts
            else split.split_by_value(source.dataset, by, share)
        )
        pieces = {cfg.out / name: sides for name, sides in named.items()}
    with ProgressBar("episodes written") as bar:
        options = CopyOptions(not cfg.copy, cfg.overwrite, bar.start, bar.advance)
        done = split.write_split(source, pieces, share, options)
    for written in done:
        print_line(str(written))
    return 0


def _check(cfg: Split) -> None:
    from robocas_ms3.core.errors import DatasetError

    sides = cfg.out_train is not None or cfg.out_val is not None
    ways = [cfg.in_place, sides, cfg.out is not None]
    if sum(ways) != 1 or (sides and (cfg.out_train is None or cfg.out_val is None)):
        ways = "one of --in-place, --out-train T --out-val V, --parts ... --out O, --by ... --out O"
        raise DatasetError("how to split?", expected=ways)
    if cfg.parts and cfg.out is None:
        raise DatasetError("parts need a folder", expected="--out")
    if cfg.out is not None and not cfg.parts and cfg.by in (None, "seed"):
        raise DatasetError("what is a part?", expected="--parts, or --by task or target")
    if cfg.in_place and cfg.by and cfg.val_share is None:
        raise DatasetError("how much validates?", expected="--val-share")
