"""Files appear whole or not at all: write beside the target, then rename."""

from __future__ import annotations

import errno
import fcntl
import glob
import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from robocas_ms3.errors import OutputExistsError, RobocasError

ABANDONED = 86400.0  # s without a change: what a killed run left


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; on success it replaces ``path``, on failure it is removed.

    The temporary name keeps the suffix, since many writers choose their format by it.
    """
    path = Path(path)
    make_folder(path.parent)
    tmp = path.parent / f".{path.stem}.{os.getpid()}.tmp{path.suffix}"
    try:
        yield tmp
        os.replace(tmp, path)
    finally:
        if tmp.is_dir():
            shutil.rmtree(tmp, ignore_errors=True)
        else:
            tmp.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path | str) -> Iterator[Path]:
    """Yield a fresh folder beside ``path``; on success it becomes ``path`` (an older one goes), else it is removed."""
    path = Path(path)
    make_folder(path.parent)
    _sweep(path)
    tmp = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent))
    tmp.chmod(0o755)
    try:
        yield tmp
        _move_in(tmp, path)
    finally:
        shutil.rmtree(tmp, ignore_errors=True)


def _move_in(tmp: Path, path: Path, tries: int = 5) -> None:
    """Rename a folder onto another, which may be there, or come between."""
    for left in reversed(range(tries)):
        old = None
        if path.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".old", dir=path.parent))
            with suppress(FileNotFoundError):
                os.replace(path, old / "old")
        try:
            os.replace(tmp, path)
            return
        except OSError as error:  # another run has moved its own in
            if not left or error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        finally:
            if old is not None:
                shutil.rmtree(old, ignore_errors=True)


def _sweep(path: Path) -> None:
    """Mend what killed runs left beside a folder: one killed between its two renames gets the old folder back."""
    name = glob.escape(path.name)
    with suppress(OSError):  # another run may be at it too
        for old in path.parent.glob(f".{name}.*.old/old"):
            if not path.exists():
                os.replace(old, path)
        for leftover in [*path.parent.glob(f".{name}.*.tmp"), *path.parent.glob(f".{name}.*.old")]:
            if time.time() - leftover.stat().st_mtime > ABANDONED:
                shutil.rmtree(leftover, ignore_errors=True)


def make_folder(path: Path | str) -> Path:
    """Make a folder and its parents, and check that it can be written to.

    Raises:
        RobocasError: it can't be made or written to.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RobocasError("can't make this folder", where=path, found=error.strerror, fix="Choose another.") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise RobocasError("this folder is not writable", where=path, fix="Choose another, or change its permissions.")
    return path


def claim_output(path: Path | str, *, overwrite: bool = False, resume: bool | None = False) -> None:
    """Refuse an output that exists, unless the user said what to do with it.

    What is overwritten disappears at once: a run killed while it deletes leaves no half of it under this name.

    Args:
        path: of the output.
        overwrite: whether to replace it.
        resume: whether to go on with it; None where that can't be done.

    Raises:
        OutputExistsError: ``path`` exists and is not empty, and neither flag is set.
        RobocasError: it can't be moved away.
    """
    path = Path(path)
    taken = path.exists() and not (path.is_dir() and not any(path.iterdir()))
    if taken and not (overwrite or resume):
        ways = ("" if resume is None else "--resume to go on, ") + "--overwrite to replace it"
        raise OutputExistsError("the output exists already", where=path, fix=f"Pass {ways}.")
    for old in path.parent.glob(f".{glob.escape(path.name)}.*.old"):
        if not (old / "old").exists():  # that of a folder being replaced, which may have to come back
            shutil.rmtree(old, ignore_errors=True)
    if taken and overwrite:
        _remove(path)


def _remove(path: Path) -> None:
    """Delete a file or a folder, which is renamed first."""
    if not path.is_dir():
        path.unlink()
        return
    target = path.resolve()  # a link to a folder goes on leading to one
    old = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".old", dir=make_folder(target.parent)))
    try:
        os.replace(target, old)
    except OSError as error:
        old.rmdir()
        what = "can't replace this folder"
        raise RobocasError(what, where=path, found=error.strerror, fix="Choose another.") from error
    if path.is_symlink():
        target.mkdir()
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def locked_folder(path: Path | str) -> Iterator[None]:
    """Hold a lock on a folder that may not exist yet; it ends with the process, however that ends.

    If the folder is not there in the end, the parents made for the lock go too.

    Raises:
        RobocasError: another process holds it, or nothing can be written there.
    """
    path = Path(path)
    new = [folder for folder in path.parents if not folder.exists()]
    lock = path.parent / f".{path.name}.lock"
    try:
        with _locked(lock, path):
            try:
                yield
            finally:
                lock.unlink(missing_ok=True)
    finally:
        if not path.exists():
            with suppress(OSError):  # nothing came of it; another run may be in them
                for folder in new:
                    folder.rmdir()


def _locked(lock: Path, path: Path) -> TextIOWrapper:
    """Open and lock a file that whoever held it before may just have removed."""
    while True:
        make_folder(lock.parent)
        try:
            file = lock.open("w")
        except OSError as error:  # it says that it is writable, as those of /proc do
            what = "can't write into this folder"
            raise RobocasError(what, where=lock.parent, found=error.strerror, fix="Choose another.") from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), lock.stat()):
                    return file
        except OSError as error:
            file.close()
            raise RobocasError("another process is writing here", where=path, fix="Wait until it is done.") from error
        file.close()


def write_json(path: Path | str, data: Any) -> None:
    """Write JSON whole or not at all."""
    with replacing(path) as tmp:
        tmp.write_text(json.dumps(data, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
