"""Atomic writes: a file or folder is written under a temporary name next to its target, and then renamed."""

from __future__ import annotations

import ctypes
import errno
import glob
import json
import os
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedRandom, FileIO
from pathlib import Path
from typing import Any, TypeVar

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.paths import find_path_variable

_Error = TypeVar("_Error", bound=RobocasError)
DISK_FULL_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Error numbers of a full disk or an exceeded quota."""
LEFTOVER_AGE = 86400.0
"""Seconds since the last change after which temporary folders of other runs are deleted: their run was killed."""
_SHOWN_KEYS = 8  # of the path to an invalid value, in a message
_NAME_BYTES = 96  # of stem and suffix in a temporary name; file systems allow 255 in total
_TRIES = 5  # renames of a folder that other processes replace at the same time


@contextmanager
def add_path_to_errors(path: Path | str) -> Iterator[None]:
    """Add a path to each OSError that has no path, such as an error of writing to an open file.

    If the disk is full while a file is copied, the OSError names the source file; the path replaces this name.
    """
    try:
        yield
    except OSError as error:
        copied = error.filename2 and error.errno in DISK_FULL_ERRNOS
        if error.errno is None or (error.filename and not copied):
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error


@contextmanager
def atomic_file(path: Path | str, *, sync: bool = False) -> Iterator[Path]:
    """Yield a temporary path next to ``path``; rename it to ``path`` on success, delete it on failure.

    The temporary name keeps the suffix, since many writers choose the format by it. It is random, so that no other user
    can place a symbolic link there.

    Args:
        path: of the file.
        sync: whether to flush the file to the disk before the rename, so that a power failure leaves no partial file.
    """
    path = Path(path)
    make_folder(path.parent)
    stem, suffix = (os.fsencode(part)[:_NAME_BYTES].decode(errors="ignore") for part in (path.stem, path.suffix))
    tmp = path.parent / f".{stem}.{secrets.token_hex(8)}.tmp{suffix}"
    try:
        with add_path_to_errors(path):
            yield tmp
            if sync:
                _flush_file(tmp)
            os.replace(tmp, path)
            if sync:
                _flush_file(path.parent)
    finally:
        with suppress(FileNotFoundError):
            delete_path(tmp)


def open_for_append(path: Path) -> BufferedRandom:
    """Open or create a file for reading and appending; raise RobocasError for a symbolic link, pipe or device."""
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    found = "a pipe or device"
    try:
        descriptor = os.open(path, flags, 0o666)
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            return BufferedRandom(FileIO(descriptor, "r+"))
        os.close(descriptor)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        found = f"a symbolic link to {os.readlink(path)}"
    what, fix = "this path is not a regular file and is not written to", "Remove it, or choose another output folder."
    raise RobocasError(what, where=path, expected="a regular file", found=found, fix=fix)


def _flush_file(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def atomic_folder(path: Path | str, *, sync: bool = False) -> Iterator[Path]:
    """Yield a new folder next to ``path``; rename it to ``path`` on success, delete it on failure.

    If ``path`` cannot be renamed (see `cannot_be_renamed`), the entries of the new folder are moved into it one by one.

    Args:
        path: of the folder.
        sync: whether to flush the files to the disk before the rename: a power failure leaves no partial folder.
    """
    path = Path(path)
    fixed = cannot_be_renamed(path)
    home = make_folder(path if fixed else path.parent)
    _recover_killed_run(path)
    tmp = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".tmp", dir=home))
    tmp.chmod(0o755)
    try:
        with add_path_to_errors(path):
            yield tmp
            if sync:
                flush_to_disk(tmp)
            if fixed:
                clear_folder(path, keep=tmp)
                for entry in list(tmp.iterdir()):
                    os.replace(entry, path / entry.name)
            else:
                _replace_folder(tmp, path)
    finally:
        shutil.rmtree(tmp, ignore_errors=True)


def cannot_be_renamed(folder: Path) -> bool:
    """Return whether a folder cannot be renamed, because it is a mount point or its parent is read-only."""
    return folder.is_dir() and (os.path.ismount(folder) or not os.access(folder.resolve().parent, os.W_OK | os.X_OK))


def clear_folder(folder: Path, keep: Path | None = None) -> None:
    """Delete the content of a folder, except the entry ``keep``."""
    for entry in folder.iterdir():
        if entry != keep:
            delete_path(entry)


def delete_path(path: Path) -> None:
    """Delete a file, a folder or a symbolic link; the target of a link stays."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def _replace_folder(tmp: Path, path: Path) -> None:
    """Replace the folder ``path`` by ``tmp`` with renames; other processes may replace ``path`` at the same time."""
    for tries_left in reversed(range(_TRIES)):
        old = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".old", dir=path.parent))
        try:
            if path.exists():
                with suppress(FileNotFoundError):
                    os.replace(path, old / "old")
            os.replace(tmp, path)
            return
        except OSError as error:
            if not tries_left or error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        finally:
            shutil.rmtree(old, ignore_errors=True)


def _recover_killed_run(path: Path) -> None:
    """Restore the folder if a run was killed within `_replace_folder`; delete old temporary folders."""
    name = glob.escape(path.name)
    with suppress(OSError):  # another run may do the same at the same time
        for old in path.parent.glob(f".{name}.*.old/old"):
            if not path.exists():
                os.replace(old, path)
        for leftover in [*path.parent.glob(f".{name}.*.tmp"), *path.parent.glob(f".{name}.*.old")]:
            if time.time() - leftover.stat().st_mtime > LEFTOVER_AGE:
                shutil.rmtree(leftover, ignore_errors=True)


def make_folder(path: Path | str) -> Path:
    """Create a folder and its parents; raise RobocasError if it cannot be created or is not writable."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        if os.access(path, os.W_OK | os.X_OK):
            return path
        what, found = "this folder is not writable", ""
    except OSError as error:
        what, found = "cannot create this folder", error.strerror or ""
    variable = find_path_variable(path)
    fix = f"Set {variable} to a writable folder." if variable else "Choose another folder."
    raise RobocasError(what, where=path, found=found, fix=fix)


def flush_to_disk(folder: Path | str) -> None:
    """Flush the file system that contains a folder to the disk, so that the files survive a power failure."""
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
    """Write values to a JSON file with `atomic_file`, as text from `encode_json`."""
    text = encode_json(data, path, indent=2) + "\n"
    with atomic_file(path, sync=sync) as tmp:
        tmp.write_text(text, encoding="utf-8")


def encode_json(
    data: Any, where: object, *, indent: int | None = None, ascii_only: bool = False, error: type[_Error] = RobocasError
) -> str:
    """Return values as JSON text that `documents.load_json` and pydantic accept, on one line if ``indent`` is None.

    Raises:
        RobocasError: an ``error`` for a value that these readers refuse, such as NaN; its ``where`` has the key.
    """
    from robocas_ms3.core.documents import find_invalid_value  # imports YAML, which `robocas --help` does not need

    if invalid := find_invalid_value(data):
        keys, found = invalid
        place = f"{where}, {'.'.join(map(str, keys[:_SHOWN_KEYS]))}" if keys else where
        expected = "finite numbers of 64 bits, Unicode text, JSON types"
        raise error("cannot write this value as JSON", where=place, expected=expected, found=found)
    return json.dumps(data, indent=indent, ensure_ascii=ascii_only, allow_nan=False)
