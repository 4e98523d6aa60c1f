"""Locks on folders and files, which end with the process that holds them."""

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
from robocas_ms3.core.files import is_fixed, make_folder, open_for_append

LOCK = ".lock"
"""Name of the lock file inside a folder that can't have it next to it, such as a mount point."""
# Raised by network file systems that have no locks, or whose lock server is down
_NO_LOCKS = frozenset({errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS})
_DYING = 0.5  # s that a killed process, or a child that it was starting, may still hold a lock
_log = logging.getLogger(__name__)


@contextmanager
def locked_folder(path: Path | str) -> Iterator[None]:
    """Hold a lock on a folder, which may not exist yet; see `lock_file`.

    Parent folders that were made for the lock are removed if the folder does not exist in the end.
    """
    path = Path(path)
    new = [folder for folder in path.parents if not folder.exists()]
    real = path.resolve()  # one lock file whatever link leads to the folder, and outside if the folder may be replaced
    lock = path / LOCK if is_fixed(path) else real.parent / f".{real.name}.lock"
    try:
        with _open_locked(lock, path):
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
    """Lock an open file until it is closed; a file system without locks gives a warning.

    Raises RobocasError, which names ``path``, if another process holds the lock and ``wait`` is not set.
    """
    until = time.monotonic() + _DYING
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            return
        except BlockingIOError as error:
            if time.monotonic() > until:
                what, fix = "another process is writing here", "Wait until it is done."
                raise RobocasError(what, where=path, fix=fix) from error
            time.sleep(0.02)
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise RobocasError("can't lock this folder", where=path, found=error.strerror) from error
            _log.warning("%s: its file system has no locks (%s): run one command at a time", path, error.strerror)
            return


def _open_locked(lock: Path, path: Path) -> IO[bytes]:
    """Open and lock a file; again if the process that held the lock has removed the file in between."""
    while True:
        make_folder(lock.parent)
        try:
            file = open_for_append(lock)
        except OSError as error:  # folders of /proc look writable
            what = "can't write into this folder"
            raise RobocasError(what, where=lock.parent, found=error.strerror, fix="Choose another.") from error
        try:
            lock_file(file, path, wait=False)
        except BaseException:
            file.close()
            raise
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), lock.lstat()):
                return file
        file.close()
