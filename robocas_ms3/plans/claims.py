"""Who is at a unit, where jobs of several machines share nothing but a folder: no locks reach from one to the other.

The claims on a unit are numbered files, and the highest one counts. Whoever wants the unit makes the next number, which
only one can (a file is created or it is there already, on NFS too), and may do so only once the claim before is given
back, or was not renewed for a while: its *lease*. Who holds a claim renews it ten times a lease. If it can't for half
a lease, or finds a higher number, its process ends at once: so a job that lost its network, or one that Slurm began
again elsewhere while the first still lived, has left before the next one comes. Ages are told by the clock of the file
server alone: a claim's time of change against that of a file just touched. A claim that is given back is of 1970.

A process that was halted itself looks as soon as it wakes, and goes on if nobody came.

One gap remains: a machine that is halted for longer than a lease as a whole and then wakes looks only after up to a
tenth of it. What two could do in that time is little: episodes of a seed are the same whoever makes them, are renamed
into place, and of two lines of a ledger the first counts.
"""

from __future__ import annotations

import errno
import glob
import logging
import os
import re
import socket
import stat
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.files import make_folder

LEASE = 60.0
"""Seconds without news after which the holder of a claim counts as dead."""
_LONGEST = 86400.0  # s; a damaged file must not stop a plan for ever
_TEXT_LIMIT = 4096  # bytes of a claim
_NUMBER = re.compile(r"[0-9]{1,9}")
_BOOT = Path("/proc/sys/kernel/random/boot_id")
# What the system says where a file can't have two names
_NO_LINKS = frozenset({errno.EPERM, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK})
_log = logging.getLogger(__name__)


@contextmanager
def claimed(
    path: Path,
    lease: float = LEASE,
    on_lost: Callable[[], object] = lambda: os._exit(75),
    on_gone: Callable[[], object] | None = None,
    *,
    stays: bool = True,
) -> Iterator[Path]:
    """Hold the claim on something, and yield its file; waits as long as somebody else holds it.

    Args:
        path: of the claims, without their number.
        lease: s; whoever asks goes by the one that the claim it finds was made with.
        on_lost: ends at once what is done inside, from another thread; by default this process.
        on_gone: the same where the whole folder was removed; default: ``on_lost``.
        stays: whether its file does when it is given back, so that the next one has the next number.
    """
    token = f"{socket.gethostname()} {os.getpid()} {uuid.uuid4().hex} {lease} {_boot()}"
    claim = _take(path, token, lease)
    keeper = _Keeper(claim, token, lease, on_lost, on_gone or on_lost)
    try:
        yield claim
    finally:
        keeper.end()
        with suppress(OSError):  # then it ends with its lease
            if read_claim(claim) == token:
                os.utime(claim, (0, 0))
                if not stays:
                    claim.unlink()


def refuse_claimed(folder: Path) -> None:
    """See that nobody is at anything that is claimed in a folder; whoever claims nothing could be there too.

    Args:
        folder: of all claims; need not exist.

    Raises:
        PlanError: somebody is.
    """
    places = sorted({path.with_suffix("") for path in folder.glob("*/*.[0-9]*")})
    for claims in filter(None, map(claims_of, places)):
        claim = claims[max(claims)]
        with suppress(FileNotFoundError):
            if claim.stat().st_mtime > 0 and (age := age_of(claim)) < 2 * lease_of(claim):  # with room to spare
                fix = "Go on with --on slurm, or cancel its jobs and wait until the claim is not renewed any more."
                found = f"{read_claim(claim).split(' ')[0]}, {age:.0f} s ago"
                raise PlanError("jobs of Slurm are at this plan", where=claim, found=found, fix=fix)


class _Keeper:
    """Renews a claim, and says when it is lost; two threads, as a file server that hangs holds one up."""

    def __init__(
        self,
        claim: Path,
        token: str,
        lease: float,
        on_lost: Callable[[], object],
        on_gone: Callable[[], object],
    ) -> None:
        self._claim, self._token, self._lease, self._on_lost, self._on_gone = claim, token, lease, on_lost, on_gone
        self._renewed, self._ended = time.monotonic(), threading.Event()
        self._renewer = threading.Thread(target=self._renew, daemon=True)
        for thread in (self._renewer, threading.Thread(target=self._watch, daemon=True)):
            thread.start()

    def _renew(self) -> None:
        following = _numbered(self._claim.with_suffix(""), int(self._claim.suffix[1:]) + 1)
        while not self._ended.wait(self._lease / 10):
            before = time.monotonic()
            try:
                if following.exists() or read_claim(self._claim) != self._token:
                    self._lose("somebody else has it", self._on_lost)
                    return
                os.utime(self._claim)
            except FileNotFoundError:
                if self._claim.parent.is_dir():
                    self._lose("somebody removed it", self._on_lost)
                else:
                    self._lose("its folder is gone", self._on_gone)
                return
            except OSError as error:  # for a moment, mostly
                _log.warning("%s can't be renewed: %s", self._claim, error)
            else:
                self._renewed = before

    def _watch(self) -> None:
        pause = min(1.0, self._lease / 20)
        while True:
            before = time.monotonic()
            if self._ended.wait(pause):
                return
            if self._is_late() and time.monotonic() - before > pause + self._lease / 4:
                self._ended.wait(self._lease / 10)  # this process was halted: the other thread looks now, and renews
            if self._is_late():
                self._lose("it could not be renewed", self._on_lost)
                return

    def _is_late(self) -> bool:
        return time.monotonic() - self._renewed > self._lease / 2

    def _lose(self, why: str, then: Callable[[], object]) -> None:
        """Say so, and have what is done inside ended, without asking a file server that may hang for anything."""
        if not self._ended.is_set():
            self._ended.set()
            said = threading.Thread(target=_log.error, args=("%s is lost: %s", self._claim, why), daemon=True)
            said.start()
            said.join(1.0)  # a log may lie there too
            then()

    def end(self) -> None:
        """Renew it no more."""
        self._ended.set()
        self._renewer.join(self._lease)


def _take(path: Path, token: str, lease: float) -> Path:
    make_folder(path.parent)
    said = False
    while True:
        last = max(claims_of(path), default=0)
        try:
            free = not last or age_of(before := _numbered(path, last)) >= lease_of(before, lease)
            if free and _make(claim := _numbered(path, last + 1), token):
                return claim
        except FileNotFoundError:  # a claim went just now, or a file that another one who begins took for a leftover
            if not path.parent.is_dir():
                raise
            continue
        if not (free or said):
            said = True
            _log.warning("waiting: another process is at %s", path)
        time.sleep(min(2.0, lease / 10))


def _make(claim: Path, token: str) -> bool:
    """Make a claim that has its text from the first moment; False: another one was first."""
    new = _temporary(claim)
    try:
        new.write_text(token, encoding="utf-8")
        os.link(new, claim)
        return True
    except FileExistsError:
        return read_claim(claim) == token  # its answer was lost, and the file server asked again
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
    finally:
        new.unlink(missing_ok=True)
    try:
        with claim.open("x", encoding="utf-8") as file:
            file.write(token)
    except FileExistsError:
        return False
    except OSError:  # a full disk
        claim.unlink(missing_ok=True)
        raise
    return True


def read_claim(claim: Path) -> str:
    """Return the text of a claim: machine, process, id, lease and start of the machine.

    Raises:
        PlanError: its file is a pipe or a device.
        OSError: its file cannot be read.
    """
    with _open(claim) as file:
        return file.read(_TEXT_LIMIT).decode(errors="replace")


def _open(claim: Path) -> BinaryIO:
    descriptor = os.open(claim, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        what, fix = "this claim is not a regular file", "Remove it."
        raise PlanError(what, where=claim, expected="a regular file", found="a pipe, a device or a folder", fix=fix)
    return os.fdopen(descriptor, "rb")


def _temporary(claim: Path) -> Path:
    """A name beside a claim that is none of its numbers."""
    return claim.with_name(f".{claim.stem.lstrip('.')}.t{uuid.uuid4().hex}.tmp")


def claims_of(path: Path) -> dict[int, Path]:
    """Return the files of the claims on something, by number; other names in the folder are none."""
    found = ((name.suffix[1:], name) for name in path.parent.glob(f"{glob.escape(path.name)}.[0-9]*"))
    return {int(number): name for number, name in found if _NUMBER.fullmatch(number)}


def _numbered(path: Path, number: int) -> Path:
    return path.with_name(f"{path.name}.{number}")


def lease_of(claim: Path, default: float = LEASE) -> float:
    """Return the lease of a claim in s; the default where its file is empty, as after a kill, or damaged."""
    try:
        lease = float(read_claim(claim).split(" ")[3])
    except (OSError, ValueError, IndexError):
        return default
    return lease if 0 < lease <= _LONGEST else default


def is_of_here(text: str) -> bool:
    """Whether what a claim says is of this machine, since it was started: several may have one name."""
    words = text.split(" ")
    return words[0] == socket.gethostname() and words[4:5] == [_boot()]


def _boot() -> str:
    """What no two machines have in common, nor two starts of one; ``-`` where the system has no such thing."""
    with suppress(OSError):
        return _BOOT.read_text(encoding="utf-8").strip() or "-"
    return "-"


def age_of(claim: Path) -> float:
    """Seconds since a claim was renewed, by the file server's clock.

    Raises:
        FileNotFoundError: it is not there any more.
    """
    probe = _temporary(claim)
    try:
        probe.touch()
        os.utime(probe)
        now = probe.stat().st_mtime
    finally:
        probe.unlink(missing_ok=True)
    with _open(claim) as file:  # to open a file asks the server; to look at its name may not
        return now - os.fstat(file.fileno()).st_mtime
