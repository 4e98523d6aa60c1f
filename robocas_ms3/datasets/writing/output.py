"""The folder a dataset is written into, and files of others that get there; its rules: `robocas_ms3.core.outputs`."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.core import outputs
from robocas_ms3.core.documents import check_regular, load_json
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import make_folder, write_json
from robocas_ms3.core.locks import locked_folder
from robocas_ms3.core.outputs import claim_output, is_taken, kept_if_begun, sweep
from robocas_ms3.datasets import schema

MARKS = (schema.CONVERSION_FILE, schema.DATA_INFO_FILE)
"""A folder with one of these is a RoboCAS dataset, whole or not."""
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
def begun_output(
    out: Path, plan: Mapping[str, Any], *, inputs: Sequence[Path], overwrite: bool, resume: bool
) -> Iterator[Path]:
    """Claim and lock a dataset's folder and write ``conversion.json``, which says what will be in it.

    If what is done inside fails before there is an episode, the folder goes again; otherwise ``resume`` goes on.

    Args:
        out: the folder.
        plan: content of ``conversion.json``.
        inputs: datasets that are read, which ``out`` may not touch.
        overwrite: replace a dataset that is there.
        resume: go on with what was begun by the same plan.

    Raises:
        OutputExistsError: ``out`` is not empty and neither flag is set.
        DatasetError: it is an input, or what is there is no dataset or another one.
    """
    plan = json.loads(json.dumps(plan))
    check_apart(out, inputs)
    with locked_folder(out):
        claim_output(out, resume=resume or overwrite)
        if resume:
            _check_begun(out, plan)
        elif overwrite:
            check_overwrite(out)
        claim_output(out, overwrite=overwrite and not resume, resume=True)
        make_folder(out)
        with kept_if_begun(out):
            sweep(out)
            write_json(out / schema.CONVERSION_FILE, plan)
            yield out


def check_overwrite(out: Path, marks: Sequence[str] = MARKS, what: str = "a dataset") -> None:
    """Delete datasets only; see `outputs.check_overwrite`.

    Raises:
        DatasetError: it holds something else.
    """
    outputs.check_overwrite(out, marks, what, DatasetError)


def check_apart(out: Path, inputs: Sequence[Path]) -> None:
    """Refuse an output that is an input, or in one, or holds one.

    Raises:
        DatasetError: it is.
    """
    target = out.resolve()
    for path in (path.resolve() for path in inputs):
        if path == target or path in target.parents or target in path.parents:
            raise DatasetError("the output is an input, or one is in the other", where=out, fix="Choose another --out.")


def _check_begun(out: Path, plan: Mapping[str, Any]) -> None:
    if not is_taken(out):
        return
    path = out / schema.CONVERSION_FILE
    try:
        before = load_json(path)
    except (OSError, ValueError) as error:
        raise DatasetError("can't resume: nothing was begun here", where=path, fix="Pass --overwrite.") from error
    if not isinstance(before, dict):
        raise DatasetError(
            "can't resume: this JSON is damaged", where=path, expected="an object", fix="Pass --overwrite."
        )
    different = sorted(key for key in plan if key != "made_with" and before.get(key) != plan[key])
    if different:
        raise DatasetError(
            "can't resume: something else was begun here",
            where=path,
            found=f"other {', '.join(different)}",
            fix="Pass --overwrite, or the inputs and options of before.",
        )
