"""``robocas upgrade``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass
class Upgrade:
    """Bring a dataset of an older robocas up to date, in place: every episode then says how it was made.

    Pictures and arrays stay as they are. Killed at any moment, the same command goes on.
    """

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset."""
    trajectory: tuple[Path, ...] = ()
    """The files it was converted from; without, what only they know (layout, objects, configuration) stays unknown, and
    the same command with them completes it later."""


def main(cfg: Upgrade) -> int:
    """Upgrade, with a progress bar; gives the exit code."""
    from robocas_ms3.cli.bars import bar, say
    from robocas_ms3.datasets.described import count_of
    from robocas_ms3.datasets.manage.upgrading import upgrade
    from robocas_ms3.datasets.schema import SCHEMA_VERSION

    with bar("episodes") as shown:
        done = upgrade(cfg.dataset, trajectories=cfg.trajectory, on_start=shown.start, on_episode=shown.advance)
    if done.before == SCHEMA_VERSION and not done.described:
        text = f"is of version {SCHEMA_VERSION} already; nothing to do"
    else:
        text = f"was of version {done.before}; {count_of(len(done.described), 'episode')} described"
    if done.incomplete:
        text += f"; of {count_of(len(done.incomplete), 'episode')} the layout is not known (--trajectory)"
    say(f"{cfg.dataset}: {text}")
    return 0
