"""The folder a dataset is written into, and files of others that get there; its rules: `robocas_ms3.core.outputs`."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.core.documents import check_regular
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.outputs import FolderKind, OutputFolder
from robocas_ms3.datasets import schema
from robocas_ms3.demos.recordings.versions import versions

MARKS = (schema.CONVERSION_FILE, schema.DATA_INFO_FILE)
"""A folder with one of these is a RoboCAS dataset, whole or not."""


def with_versions(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record with the versions of today where it does not name them all, as of merged datasets."""
    now, made_with = versions(), record.get("made_with")
    is_whole = isinstance(made_with, dict) and now.keys() <= made_with.keys()
    return record if is_whole else {**record, "made_with": now}


DATASET = FolderKind("robocas convert", (schema.CONVERSION_FILE,), "rate_hz", marks=MARKS, upgrade=with_versions)
_NO_LINKS = {errno.EXDEV, errno.EPERM, errno.EACCES, errno.EMLINK, errno.EOPNOTSUPP, errno.ENOSYS}


@dataclass
class Placer:
    """Puts files into a dataset.

    Attributes:
        link: whether to try hard links; files of another file system are copied all the same.
        linked, copied: how many files so far.
    """

    link: bool
    linked: int = 0
    copied: int = 0

    def file(self, source: Path, target: Path) -> None:
        """Link or copy one file."""
        if self.link and not source.is_symlink():
            try:
                os.link(source, target)
                self.linked += 1
                return
            except OSError as error:
                if error.errno not in _NO_LINKS:
                    raise
                self.link = error.errno == errno.EMLINK  # a limit of this file alone
        check_regular(source)
        shutil.copyfile(source, target)
        self.copied += 1

    def tree(self, source: Path, target: Path) -> None:
        """Link or copy a folder's files into another, which is there; hidden ones are left."""
        with os.scandir(source) as entries:
            for entry in sorted(entries, key=lambda entry: entry.name):
                if entry.name.startswith("."):
                    continue
                if entry.is_dir():
                    (target / entry.name).mkdir()
                    self.tree(Path(entry.path), target / entry.name)
                elif entry.is_file():
                    self.file(Path(entry.path), target / entry.name)


@contextmanager
def dataset_output(
    out: Path, record: Mapping[str, Any], *, inputs: Sequence[Path], overwrite: bool
) -> Iterator[OutputFolder]:
    """Start or continue a dataset that is written from other datasets.

    Args:
        out: its folder.
        record: content of ``conversion.json``, which has to match to continue, whatever the versions.
        inputs: datasets that are read, which ``out`` may not touch.
        overwrite: start again, and replace a dataset that exists.

    Raises:
        OutputExistsError: ``out`` is another dataset, or none.
        DatasetError: ``out`` is an input.
    """
    check_apart(out, inputs)
    with OutputFolder(out, DATASET, settings_of(record), overwrite=overwrite) as output:
        output.start(record)
        yield output


def settings_of(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return what has to match in ``conversion.json`` to continue a dataset made of others: all but the versions."""
    return {key: value for key, value in record.items() if key != "made_with"}


def check_apart(out: Path, inputs: Sequence[Path]) -> None:
    """Refuse an output that is an input, or in one, or holds one.

    Raises:
        DatasetError: it is.
    """
    target = out.resolve()
    for path in (path.resolve() for path in inputs):
        if path == target or path in target.parents or target in path.parents:
            raise DatasetError("the output is an input, or one is in the other", where=out, fix="Choose another --out.")
