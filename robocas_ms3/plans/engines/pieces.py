"""Files of a unit on their way from a machine that does not see the plan's folder; a few MB are in memory at once."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from robocas_ms3.core.files import flush_to_disk, make_folder
from robocas_ms3.core.outputs import sweep
from robocas_ms3.plans.units import DEATHS, EPISODES, LEDGER, Outcome, ledger

PIECE = 16 * 2**20
"""Bytes that are sent at once, at most."""
Pieces = list[tuple[str, bytes]]
"""Path in the unit's folder, and what comes next in that file."""


def sent(folder: Path, piece: int = PIECE) -> Iterator[Pieces]:
    """Read the files of a unit, all but its ledger; those that won't be needed again are deleted."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != LEDGER)
    pieces, left = [], piece
    for path in paths:
        with path.open("rb") as file:
            while True:
                data = file.read(left)
                pieces.append((path.relative_to(folder).as_posix(), data))
                left -= len(data)
                if left:
                    break  # the file's end
                yield pieces
                pieces, left = [], piece
        if path.name != DEATHS:
            path.unlink()
    if pieces:
        yield pieces


class Arriving:
    """Files that arrive at a unit's folder, where they appear whole; nobody else may write there.

    Args:
        folder: the unit's.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._new = folder, folder / ".arriving.tmp"
        make_folder(folder / EPISODES)
        sweep(folder)

    def take(self, pieces: Pieces) -> None:
        """Write what has come, where nobody looks yet."""
        for name, data in pieces:
            path = self._new / name
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("ab") as file:
                file.write(data)

    def keep(self, outcome: Outcome | None = None) -> None:
        """Move what was taken into place, and then note what came of the seed it belongs to."""
        for new in [*self._new.glob(f"{EPISODES}/*"), *self._new.glob("*.*")]:
            path = self._folder / new.relative_to(self._new)
            if path.is_dir():  # moved by one that was killed before it noted the seed
                shutil.rmtree(path)
            os.replace(new, path)
        shutil.rmtree(self._new, ignore_errors=True)
        if outcome is not None:
            if outcome.success:
                flush_to_disk(self._folder)
            ledger(self._folder).append([outcome], sync=True)
