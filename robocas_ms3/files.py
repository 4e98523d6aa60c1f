"""Files appear whole or not at all: write beside the target, then rename."""

from __future__ import annotations

import ctypes
import errno
import glob
import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from robocas_ms3.errors import RobocasError
from robocas_ms3.paths import variable_of

FULL = frozenset({errno.ENOSPC, errno.EDQUOT})  # what the system says of a disk without room
ABANDONED = 86400.0  # s without a change: what a killed run left


@contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Give errors of the system a path where they have none: writing into an open file says no name.

    What copies a file names the one it reads, and that of a full disk too: then it is this one.
    """
    try:
        yield
    except OSError as error:
        copied = error.filename2 and error.errno in FULL
        if error.errno is None or (error.filename and not copied):
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error


@contextmanager
def replacing(path: Path | str, *, sync: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; on success it replaces ``path``, on failure it is removed.

    The temporary name keeps the suffix, since many writers choose their format by it.

    Args:
        path: of the file.
        sync: whether it survives a power cut from then on, and none leaves half of it under its name.
    """
    path = Path(path)
    make_folder(path.parent)
    tmp = path.parent / f".{path.stem}.{os.getpid()}.tmp{path.suffix}"
    try:
        with naming(path):
            yield tmp
            if sync:
                _sync(tmp)
            os.replace(tmp, path)
            if sync:
                _sync(path.parent)
    finally:
        if tmp.is_dir():
            shutil.rmtree(tmp, ignore_errors=True)
        else:
            tmp.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Wait until a file is on the disk, or what a folder says of its files."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def replacing_folder(path: Path | str, *, sync: bool = False) -> Iterator[Path]:
    """Yield a fresh folder beside ``path``; on success it becomes ``path`` (an older one goes), else it is removed.

    A folder that has to stay where it is, see `is_fixed`, gets the new one's content, one entry after the other.

    Args:
        path: of the folder.
        sync: whether its files are on the disk before it gets its name: a power cut leaves none that is half there.
    """
    path = Path(path)
    fixed = is_fixed(path)
    home = make_folder(path if fixed else path.parent)
    _sweep(path)
    tmp = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".tmp", dir=home))
    tmp.chmod(0o755)
    try:
        with naming(path):
            yield tmp
            if sync:
                flush_to_disk(tmp)
            if fixed:
                empty_folder(path, but=tmp)
                for entry in list(tmp.iterdir()):
                    os.replace(entry, path / entry.name)
            else:
                _move_in(tmp, path)
    finally:
        shutil.rmtree(tmp, ignore_errors=True)


def is_fixed(folder: Path) -> bool:
    """Whether a folder can be written into and not renamed: a mount point, or one in a folder that is read-only."""
    return folder.is_dir() and (os.path.ismount(folder) or not os.access(folder.resolve().parent, os.W_OK | os.X_OK))


def empty_folder(folder: Path, but: Path | None = None) -> None:
    """Delete what is in a folder, ``but`` one entry."""
    for entry in folder.iterdir():
        if entry == but:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


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
        raise RobocasError("can't make this folder", where=path, found=error.strerror, fix=_another(path)) from error
    if not os.access(path, os.W_OK | os.X_OK):
        fix = f"{_another(path)[:-1]}, or change its permissions."
        raise RobocasError("this folder is not writable", where=path, fix=fix)
    return path


def _another(path: Path) -> str:
    variable = variable_of(path)
    return f"Set {variable} to a folder that can be written to." if variable else "Choose another."


def flush_to_disk(folder: Path | str) -> None:
    """See that what was written on a folder's file system survives a power cut: one call for hundreds of files.

    Raises:
        OSError: it can't be written, naming the folder.
    """
    syncfs = getattr(ctypes.CDLL(None, use_errno=True), "syncfs", None)
    if syncfs is None:
        os.sync()
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        if syncfs(descriptor):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(folder))
    finally:
        os.close(descriptor)


def write_json(path: Path | str, data: Any, *, sync: bool = False) -> None:
    """Write JSON whole or not at all; ``sync`` is that of `replacing`."""
    with replacing(path, sync=sync) as tmp:
        tmp.write_text(json.dumps(data, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
