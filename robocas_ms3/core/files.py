"""Files appear whole or not at all: write beside the target, then rename."""

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
from robocas_ms3.core.paths import variable_of

_Error = TypeVar("_Error", bound=RobocasError)
FULL = frozenset({errno.ENOSPC, errno.EDQUOT})  # what the system says of a disk without room
_SHOWN_KEYS = 8  # of the way to a wrong value, in a message
_NAME_BYTES = 96  # of stem and of suffix that a temporary name repeats: file systems allow 255 in all
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

    The temporary name keeps the suffix, since many writers choose their format by it. Nobody can predict the name, so
    nobody can put a symbolic link there first.

    Args:
        path: of the file.
        sync: whether it survives a power cut from then on, and none leaves half of it under its name.
    """
    path = Path(path)
    make_folder(path.parent)
    tmp = path.parent / f".{_shortened(path.stem)}.{secrets.token_hex(8)}.tmp{_shortened(path.suffix)}"
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


def _shortened(name: str) -> str:
    return os.fsencode(name)[:_NAME_BYTES].decode(errors="ignore")


def open_for_append(path: Path) -> BufferedRandom:
    """Open a file for reading and appending; create it if missing, follow no symbolic link.

    Raises:
        RobocasError: the path is a symbolic link, or not a regular file.
        OSError: the file can't be opened.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _not_regular(path, f"a symbolic link to {os.readlink(path)}") from error
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _not_regular(path, "a pipe or device")
    return BufferedRandom(FileIO(descriptor, "r+"))


def _not_regular(path: Path, found: str) -> RobocasError:
    what, fix = "refusing to write to this file", "Remove it, or choose another output folder."
    return RobocasError(what, where=path, expected="a regular file", found=found, fix=fix)


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
        if entry != but:
            remove(entry)


def remove(path: Path) -> None:
    """Delete a file or a folder; of a symbolic link the link alone."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


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
    """Write JSON whole or not at all; ``sync`` is that of `replacing`.

    Raises:
        RobocasError: see `json_text`.
    """
    text = json_text(data, path, indent=2) + "\n"
    with replacing(path, sync=sync) as tmp:
        tmp.write_text(text, encoding="utf-8")


def json_text(
    data: Any, where: object, *, indent: int | None = None, ascii_only: bool = False, error: type[_Error] = RobocasError
) -> str:
    """Return values as a JSON text that `documents.load_json` and pydantic read.

    Args:
        data: dicts, lists, strings, numbers, booleans and None.
        where: the file or object, for messages.
        indent: spaces per level; None: one line.
        ascii_only: whether to escape all other characters.
        error: type of the error.

    Raises:
        RobocasError: ``error``: they would refuse a value, such as NaN; ``where`` names its key.
    """
    from robocas_ms3.core.documents import json_fault  # with YAML, for which `robocas --help` need not wait

    if fault := json_fault(data):
        keys, found = fault
        place = f"{where}, {'.'.join(map(str, keys[:_SHOWN_KEYS]))}" if keys else where
        expected = "finite numbers of 64 bits, Unicode text, JSON types"
        raise error("this value can't be written as JSON", where=place, expected=expected, found=found)
    return json.dumps(data, indent=indent, ensure_ascii=ascii_only, allow_nan=False)
