"""Folders that runs write into: whose they may be, what becomes of what is there, and who else may write there.

A run that writes one episode after the other takes these steps, all under `locked_folder`: `claim_output` refuses what
is there unless the user said what to do with it; `check_overwrite` keeps what is none of ours from being deleted, and
`check_run` what is another command's; `sweep` removes what a killed run left half written; `kept_if_begun` leaves no
folder behind of which nothing came.
"""

from __future__ import annotations

import errno
import fcntl
import glob
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from pathlib import Path
from typing import IO, Any

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import OutputExistsError, RobocasError
from robocas_ms3.core.files import empty_folder, is_fixed, make_folder, open_for_append, remove

# What the system says where there are none: of some network file systems, or of a lock server that is gone
_NO_LOCKS = frozenset({errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS})
_log = logging.getLogger(__name__)
_DYING = 0.5  # s that a killed process may hold a lock for: one that it was just starting has it too
_INSIDE = ".lock"  # of a folder that can't have it beside it
# What a plan's run has in its folder before it says what it is: one that was killed then leaves nothing else
_BEFORE = (_INSIDE, ".driver.*", ".plan.*.tmp.json")


def is_taken(path: Path) -> bool:
    """Whether there is something: a file, or a folder that holds more than what says who is at it."""
    if not path.is_dir():
        return path.exists()
    return any(not any(fnmatchcase(entry.name, name) for name in _BEFORE) for entry in path.iterdir())


def check_one_way(where: str, *, resume: bool, overwrite: bool, error: type[RobocasError] = RobocasError) -> None:
    """See that an output is not to be gone on with and replaced as well.

    Args:
        where: the command.
        resume: its flag.
        overwrite: its flag.
        error: to be raised.

    Raises:
        RobocasError: ``error``: both are set.
    """
    if resume and overwrite:
        raise error("these exclude each other", where=where, expected="one of them", found="--resume --overwrite")


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
    taken = is_taken(path)
    if taken and not (overwrite or resume):
        ways = ("" if resume is None else "--resume to go on, ") + "--overwrite to replace it"
        raise OutputExistsError("the output exists already", where=path, fix=f"Pass {ways}.")
    for old in path.parent.glob(f".{glob.escape(path.name)}.*.old"):
        if not (old / "old").exists():  # that of a folder being replaced, which may have to come back
            shutil.rmtree(old, ignore_errors=True)
    if taken and overwrite:
        _remove(path)


def _remove(path: Path) -> None:
    """Delete a file or a folder, which is renamed first where it can be."""
    if not path.is_dir():
        path.unlink()
        return
    if is_fixed(path):
        empty_folder(path, but=path / _INSIDE)
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


def check_absent(out: Path, error: type[RobocasError] = OutputExistsError) -> None:
    """See that there is nothing yet, where what is there is neither gone on with nor replaced.

    Raises:
        RobocasError: ``error``: there is.
    """
    if out.exists():
        raise error("there is something already", where=out, fix="Choose another --out.")


def check_there(mark: Path, error: type[RobocasError] = RobocasError) -> None:
    """See that the folder a run writes into is there still: what writes makes its folders, and would begin another.

    Args:
        mark: a file that the run wrote there first.
        error: to be raised.

    Raises:
        RobocasError: ``error``: somebody removed it.
    """
    if not mark.is_file():
        what, fix = "the output folder is gone, or emptied, while it was written to", "Begin again."
        raise error(what, where=mark.parent, expected=mark.name, fix=fix)


@contextmanager
def while_there(mark: Path, error: type[RobocasError] = RobocasError) -> Iterator[None]:
    """Let a file that is missed inside be the fault of who removed the folder, if somebody did: see `check_there`."""
    try:
        yield
    except FileNotFoundError as missed:
        try:
            check_there(mark, error)
        except RobocasError as gone:
            raise gone from missed
        raise


def check_overwrite(out: Path, marks: Sequence[str], what: str, error: type[RobocasError] = OutputExistsError) -> None:
    """See that what will be replaced is ours, whatever path was named by mistake.

    Args:
        out: the folder.
        marks: files or folders, of which one of ours has one at least.
        what: such a folder is.
        error: to be raised.

    Raises:
        RobocasError: ``error``: there is something else.
    """
    if is_taken(out) and not any((out / mark).exists() for mark in marks):
        raise error(
            f"refusing to overwrite what is not {what}", where=out, expected=" or ".join(marks), fix="Choose another."
        )


def check_same(
    before: Mapping[str, Any], now: Mapping[str, Any], what: str, *, where: Path, fix: str, error: type[RobocasError]
) -> None:
    """See that an output goes on as it was begun.

    Args:
        before: the settings it was begun with; may hold more.
        now: those it would go on with.
        what: is wrong where they differ.
        where: they are written down.
        fix: for who reads the error.
        error: to be raised.

    Raises:
        RobocasError: ``error``: some differ.
    """
    different = [key for key in now if before.get(key) != now[key]]
    if different:
        expected = ", ".join(f"{key} {before.get(key)}" for key in different)
        raise error(what, where=where, expected=expected, found=", ".join(f"{k} {now[k]}" for k in different), fix=fix)


def check_run(path: Path, key: str, command: str, error: type[RobocasError] = OutputExistsError) -> None:
    """See that notes of a run are those of a command, as several commands keep some under one name.

    Args:
        path: of the file, which may not be there.
        key: that those of the command have.
        command: that wants to write there.
        error: to be raised.

    Raises:
        RobocasError: ``error``: they are of another one.
    """
    if not path.is_file():
        return
    try:
        run = load_json(path)
    except (OSError, ValueError):
        run = None
    if not isinstance(run, dict) or key not in run:
        found = ", ".join(run) if isinstance(run, dict) else ""
        what, fix = f"refusing to write over what `robocas {command}` has not made", "Choose another --out."
        raise error(what, where=path, expected=key, found=found or "nothing of the kind", fix=fix)


@contextmanager
def locked_folder(path: Path | str) -> Iterator[bool]:
    """Hold a lock on a folder that may not exist yet; it ends with the process, however that ends.

    If the folder is not there in the end, the parents made for the lock go too.

    Yields:
        Whether it is held: False on a file system that has no locks.

    Raises:
        RobocasError: another process holds it, or nothing can be written there.
    """
    path = Path(path)
    new = [folder for folder in path.parents if not folder.exists()]
    lock = _lock_of(path)
    try:
        file, held = _locked(lock, path)
        with file:
            try:
                yield held
            finally:
                lock.unlink(missing_ok=True)
    finally:
        if not path.exists():
            with suppress(OSError):  # nothing came of it; another run may be in them
                for folder in new:
                    folder.rmdir()


def _lock_of(path: Path) -> Path:
    """One file whatever links lead to the folder; beside it, since it may be replaced, or else inside."""
    if is_fixed(path):
        return path / _INSIDE
    path = path.resolve()
    return path.parent / f".{path.name}.lock"


def _locked(lock: Path, path: Path) -> tuple[IO[bytes], bool]:
    """Open and lock a file that whoever held it before may just have removed; and whether there are locks."""
    while True:
        make_folder(lock.parent)
        try:
            file = open_for_append(lock)
        except OSError as error:  # it says that it is writable, as those of /proc do
            what = "can't write into this folder"
            raise RobocasError(what, where=lock.parent, found=error.strerror, fix="Choose another.") from error
        try:
            held = lock_file(file, path, wait=False)
        except BaseException:
            file.close()
            raise
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), lock.lstat()):
                return file, held
        file.close()


def lock_file(file: IO[Any], path: Path, *, wait: bool) -> bool:
    """Hold a lock on an open file until it is closed; on a file system that has none go on without, and say so.

    Args:
        file: open for writing.
        path: what the lock is for.
        wait: until nobody else holds it; else half a second, since one that was killed may take a moment to be gone.

    Returns:
        Whether it is held.

    Raises:
        RobocasError: somebody else holds it; or it can't be had for a reason of the system's.
    """
    until = time.monotonic() + _DYING
    try:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
                break
            except BlockingIOError as error:
                if time.monotonic() > until:
                    what, fix = "another process is writing here", "Wait until it is done."
                    raise RobocasError(what, where=path, fix=fix) from error
                time.sleep(0.02)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise RobocasError("can't lock this folder", where=path, found=error.strerror) from error
        _log.warning("%s: its file system has no locks (%s): see that no other run writes there", path, error.strerror)
        return False
    return True


def sweep(folder: Path) -> None:
    """Remove what a killed run left half written; nobody else may write here, so lock the folder before."""
    for leftover in [*folder.glob(".*.tmp*"), *folder.glob(".*.old")]:
        remove(leftover)


@contextmanager
def kept_if_begun(out: Path, parts: Path | None = None, pattern: str = "episode_*") -> Iterator[None]:
    """Delete ``out`` if what is done inside fails before there is a part; otherwise a resumed run goes on.

    Args:
        out: the folder.
        parts: the folder that gets the parts; default: the same.
        pattern: of their names.
    """
    try:
        yield
    except BaseException:
        if not any((parts or out).glob(pattern)):
            shutil.rmtree(out, ignore_errors=True)  # nothing came of it
        raise
