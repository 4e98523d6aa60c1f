"""Locks on folders and files; a lock is released when its process ends."""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.files import cannot_be_renamed, make_folder, open_for_append

LOCK = ".lock"
"""Name of the lock file inside a folder, for folders such as mount points; otherwise it is next to the folder."""
# raised by network file systems without locks or without a running lock server
_NO_LOCKS = frozenset({errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS})
_DYING = 0.5  # s for which a killed process, or a child that it was starting, may still hold a lock
_log = logging.getLogger(__name__)


@contextmanager
def lock_folder(path: Path | str) -> Iterator[None]:
    """Lock a folder, which need not exist, during the context.

    Parent folders that were created for the lock file are removed if the folder does not exist at the end.

    Raises:
        RobocasError: another process holds the lock, or the folder cannot be locked.
    """
    path = Path(path)
    new = [folder for folder in path.parents if not folder.exists()]
    real = (
        path.resolve()
    )  # one lock file for all links to the folder; next to the folder, since the folder may be replaced
    lock = path / LOCK if cannot_be_renamed(path) else real.parent / f".{real.name}.lock"
    try:
        with _open_and_lock(lock, path):
            try:
                yield
            finally:
                lock.unlink(missing_ok=True)
    finally:
        if not path.exists():
            with suppress(OSError):  # another run may write into a parent
                for folder in new:
                    folder.rmdir()


def lock_file(file: IO[Any], path: Path, *, wait: bool) -> None:
    """Lock an open file until it is closed; log a warning if the file system has no locks.

    Args:
        file: the lock file.
        path: the folder that the lock protects, for messages.
        wait: whether to wait while another process holds the lock.

    Raises:
        RobocasError: another process holds the lock and ``wait`` is False, or the file cannot be locked.
    """
    until = time.monotonic() + _DYING
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            return
        except BlockingIOError as error:
            if time.monotonic() > until:
                what, fix = "another process writes to this folder", "Wait until the other process ends."
                raise RobocasError(what, where=path, fix=fix) from error
            time.sleep(0.02)
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise RobocasError("cannot lock this folder", where=path, found=error.strerror) from error
            _log.warning(
                "%s: the file system has no locks (%s). Run only one command at a time in this folder.",
                path,
                error.strerror,
            )
            return


def _open_and_lock(lock: Path, path: Path) -> IO[bytes]:
    """Open and lock a lock file; retry if the process that held the lock removed the file in between."""
    while True:
        make_folder(lock.parent)
        try:
            file = open_for_append(lock)
        except OSError as error:  # folders in /proc report that they are writable
            what = "cannot write to this folder"
            raise RobocasError(what, where=lock.parent, found=error.strerror, fix="Choose another folder.") from error
        try:
            lock_file(file, path, wait=False)
        except BaseException:
            file.close()
            raise
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), lock.lstat()):
                return file
        file.close()
