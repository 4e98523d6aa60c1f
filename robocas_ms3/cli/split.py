"""``robocas split``: split a dataset into several datasets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from robocas_ms3.cli.options import Maybe, Several


@dataclass
class Split:
    """Split a dataset into several datasets, or choose its training and validation episodes again.

    - --out-train T --out-val V: training and validation episodes as two datasets
    - --fractions 0.8 0.2 --out O: datasets O/part_0, O/part_1, ... with these fractions of the episodes
    - --group-by task --out O: one dataset per task (or target)
    - --in-place --val-fraction 0.2: choose the validation episodes again, without copying
    - --in-place: rebuild data_info.json from the episodes on disk

    Example: robocas split datasets/pick --out-train datasets/train --out-val datasets/val
    """

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset."""
    out_train: Maybe[Path] = None
    """Output folder of the training episodes."""
    out_val: Maybe[Path] = None
    """Output folder of the validation episodes."""
    fractions: Several[float] = ()
    """Fractions of the episodes, one per new dataset; they sum to 1."""
    out: Maybe[Path] = None
    """Folder that gets one subfolder per new dataset."""
    in_place: bool = False
    """Rewrite data_info.json (the split) of the dataset instead of writing new datasets."""
    val_fraction: Maybe[float] = None
    """Draw a new validation split with this fraction of the episodes. Default: keep the split of each episode."""
    group_by: Maybe[Literal["seed", "target", "task"]] = None
    """Never separate episodes with the same seed (default), target object or task.
    With --out and without --fractions: write one dataset per task or target."""
    copy: bool = False
    """Copy files instead of hard-linking them."""
    overwrite: bool = False
    """Start again. Default: continue an interrupted split of the same inputs."""


def main(cfg: Split) -> int:
    from robocas_ms3.cli.progress import ProgressBar
    from robocas_ms3.cli.terminal import print_line
    from robocas_ms3.core.text import format_count
    from robocas_ms3.datasets.manage import split
    from robocas_ms3.datasets.manage.copy_episodes import CopyOptions, open_finished_dataset

    _check(cfg)
    group_by = cfg.group_by or "seed"
    by_value = cfg.out is not None and not cfg.fractions  # a dataset of one task or target has only one such group
    options = (
        None if cfg.val_fraction is None else split.SplitOptions(cfg.val_fraction, "seed" if by_value else group_by)
    )
    if cfg.in_place:
        train, val = split.resplit(cfg.dataset, options)
        print_line(f"{cfg.dataset}: {format_count(len(train), 'episode')} for training, {len(val)} for validation")
        return 0
    source = open_finished_dataset(cfg.dataset)
    if cfg.out_train and cfg.out_val:
        pieces = split.split_train_val(source, options, cfg.out_train, cfg.out_val)
    else:
        assert cfg.out is not None
        named = (
            split.split_by_fractions(source.dataset, cfg.fractions, group_by, options)
            if cfg.fractions
            else split.split_by_value(source.dataset, group_by, options)
        )
        pieces = {cfg.out / name: episodes for name, episodes in named.items()}
    with ProgressBar("episodes written") as bar:
        copy_options = CopyOptions(not cfg.copy, cfg.overwrite, bar.start, bar.advance)
        done = split.write_split(source, pieces, options, copy_options)
    for result in done:
        print_line(str(result))
    return 0


def _check(cfg: Split) -> None:
    from robocas_ms3.core.errors import DatasetError
    from robocas_ms3.datasets.manage.split import check_fractions

    train_val = cfg.out_train is not None or cfg.out_val is not None
    modes = {"--in-place": cfg.in_place, "--out-train and --out-val": train_val, "--out": cfg.out is not None}
    chosen = [name for name, is_chosen in modes.items() if is_chosen]
    if cfg.fractions:
        check_fractions(cfg.fractions, "--fractions")
        if cfg.out is None:
            raise DatasetError(
                "missing output folder", where="--fractions", expected="--out PATH", fix="Add --out PATH."
            )
    if len(chosen) != 1:
        what, expected = (
            "wrong number of output options",
            "one of --in-place, --out-train DIR --out-val DIR, or --out DIR",
        )
        raise DatasetError(what, where="--out", expected=expected, found=", ".join(chosen) or "none")
    if train_val and (cfg.out_train is None or cfg.out_val is None):
        where, expected = ("--out-train", "--out-val DIR") if cfg.out_train else ("--out-val", "--out-train DIR")
        raise DatasetError("missing second output folder", where=where, expected=expected, fix=f"Add {expected}.")
    if cfg.out is not None and not cfg.fractions and cfg.group_by in (None, "seed"):
        expected = "--fractions, or --group-by task or target"
        raise DatasetError(
            "missing rule of the split", where="--out", expected=expected, fix="Add one of these options."
        )
    if cfg.in_place and cfg.group_by and cfg.val_fraction is None:
        what, fix = "missing fraction of the validation episodes", "Add --val-fraction, such as 0.1."
        raise DatasetError(what, where="--group-by", expected="--val-fraction X", fix=fix)
    if cfg.val_fraction is not None and not 0 < cfg.val_fraction < 1:
        expected = "> 0 and < 1"
        raise DatasetError("invalid fraction", where="--val-fraction", expected=expected, found=cfg.val_fraction)
