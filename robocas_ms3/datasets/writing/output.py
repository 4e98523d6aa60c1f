"""How writing a dataset's folder begins and ends, whichever way it is made."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from robocas_ms3.datasets import schema
from robocas_ms3.errors import DatasetError

MARKS = (schema.CONVERSION_FILE, schema.DATA_INFO_FILE)
"""A folder with one of these is a RoboCAS dataset, whole or not."""


def check_overwrite(out: Path, marks: Sequence[str] = MARKS, what: str = "a dataset") -> None:
    """Delete datasets only, whatever folder was named by mistake.

    Args:
        out: the folder.
        marks: files or folders, of which a dataset has one at least.
        what: such a folder is.

    Raises:
        DatasetError: it holds something else.
    """
    if out.is_dir() and any(out.iterdir()) and not any((out / mark).exists() for mark in marks):
        raise DatasetError(
            f"refusing to overwrite what is not {what}", where=out, expected=" or ".join(marks), fix="Choose another."
        )


def sweep(folder: Path) -> None:
    """Remove what a killed run left half written; nobody else may write here, so lock the folder before."""
    for leftover in [*folder.glob(".*.tmp*"), *folder.glob(".*.old")]:
        shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()


@contextmanager
def kept_if_begun(out: Path, episodes: Path | None = None) -> Iterator[None]:
    """Delete ``out`` if what is done inside fails before there is an episode; otherwise a resumed run goes on.

    Args:
        out: the folder.
        episodes: the folder that gets the episodes; default: the same.
    """
    try:
        yield
    except BaseException:
        if not any((episodes or out).glob("episode_*")):
            shutil.rmtree(out, ignore_errors=True)  # nothing came of it
        raise
