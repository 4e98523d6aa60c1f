"""Who is at a unit, where jobs of several machines share nothing but a folder: no locks reach from one to the other.

The claims on a unit are numbered files, and the highest one counts. Whoever wants the unit makes the next number, which
only one can (a file is created or it is there already, on NFS too), and may do so only once the claim before is given
back, or was not renewed for a while: its *lease*. Who holds a claim renews it ten times a lease. If it can't for half
a lease, or finds a higher number, its process ends at once: so a job that lost its network, or one that Slurm began
again elsewhere while the first still lived, has left before the next one comes. Ages are told by the clock of the file
server alone: a claim's time of change against that of a file just touched. A claim that is given back is of 1970.

One gap remains: a machine that is halted for longer than a lease as a whole and then wakes looks only after up to a
tenth of it. What two could do in that time is little: episodes of a seed are the same whoever makes them, are renamed
into place, and of two lines of a ledger the first counts.
"""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from robocas_ms3.errors import PlanError
from robocas_ms3.files import make_folder

LEASE = 60.0
"""Seconds without news after which the holder of a claim counts as dead."""
_log = logging.getLogger(__name__)


@contextmanager
def claimed(path: Path, lease: float = LEASE, on_lost: Callable[[], object] = lambda: os._exit(75)) -> Iterator[Path]:
    """Hold the claim on something, and yield its file; waits as long as somebody else holds it.

    Args:
        path: of the claims, without their number.
        lease: s; whoever asks goes by the one that the claim it finds was made with.
        on_lost: ends at once what is done inside, from another thread; by default this process.
    """
    token = f"{socket.gethostname()} {os.getpid()} {uuid.uuid4().hex} {lease}"
    claim = _take(path, token, lease)
    keeper = _Keeper(claim, token, lease, on_lost)
    try:
        yield claim
    finally:
        keeper.end()
        with suppress(OSError):  # then it ends with its lease
            if claim.read_text(encoding="utf-8") == token:
                os.utime(claim, (0, 0))


def refuse_claimed(folder: Path) -> None:
    """See that nobody is at anything that is claimed in a folder; whoever claims nothing could be there too.

    Args:
        folder: of all claims; need not exist.

    Raises:
        PlanError: somebody is.
    """
    last: dict[Path, int] = {}
    for path in folder.glob("*/*.[0-9]*"):
        last[path.with_suffix("")] = max(int(path.suffix[1:]), last.get(path.with_suffix(""), 0))
    for path, number in last.items():
        claim = _numbered(path, number)
        with suppress(FileNotFoundError):
            if claim.stat().st_mtime > 0 and (age := _age(claim)) < 2 * _lease_of(claim):  # with room to spare
                fix = "Go on with --on slurm, or cancel its jobs and wait until the claim is not renewed any more."
                found = f"{claim.read_text(encoding='utf-8').split(' ')[0]}, {age:.0f} s ago"
                raise PlanError("jobs of Slurm are at this plan", where=claim, found=found, fix=fix)


@contextmanager
def sole(path: Path, lease: float = LEASE) -> Iterator[None]:
    """Hold the claim on what only one machine may do, and end this process if it is lost; see `claimed`.

    On this machine a lock tells already that nobody else is there, so a claim of its own is one that was killed.

    Raises:
        PlanError: another machine holds it.
    """
    known = _claims(path)
    refuse_other(path)
    for old in known.values():
        with suppress(FileNotFoundError):
            os.utime(old, (0, 0))
    # where the folder is gone there is nothing left to guard, and who works there says so
    with claimed(path, lease, lambda: path.parent.is_dir() and os._exit(75)) as claim:
        for old in known.values():
            old.unlink(missing_ok=True)
        yield
    claim.unlink(missing_ok=True)


def refuse_other(path: Path) -> None:
    """See that no other machine holds a claim.

    Raises:
        PlanError: one does.
    """
    claims = _claims(path)
    if not claims:
        return
    claim = claims[max(claims)]
    with suppress(FileNotFoundError):
        host = claim.read_text(encoding="utf-8").split(" ")[0]
        lease = _lease_of(claim)
        if host != socket.gethostname() and claim.stat().st_mtime > 0 and (age := _age(claim)) < lease:
            found, fix = f"{host}, {age:.0f} s ago", f"Wait until it is done, or was dead for {lease:.0f} s."
            raise PlanError("another machine runs this plan", where=path.parent, found=found, fix=fix)


class _Keeper:
    """Renews a claim, and says when it is lost; two threads, as a file server that hangs holds one up."""

    def __init__(self, claim: Path, token: str, lease: float, on_lost: Callable[[], object]) -> None:
        self._claim, self._token, self._lease, self._on_lost = claim, token, lease, on_lost
        self._renewed, self._ended = time.monotonic(), threading.Event()
        self._renewer = threading.Thread(target=self._renew, daemon=True)
        for thread in (self._renewer, threading.Thread(target=self._watch, daemon=True)):
            thread.start()

    def _renew(self) -> None:
        following = _numbered(self._claim.with_suffix(""), int(self._claim.suffix[1:]) + 1)
        while not self._ended.wait(self._lease / 10):
            before = time.monotonic()
            try:
                if following.exists() or self._claim.read_text(encoding="utf-8") != self._token:
                    self._lose("somebody else has it")
                    return
                os.utime(self._claim)
            except FileNotFoundError:
                self._lose("its folder is gone")
                return
            except OSError as error:  # for a moment, mostly
                _log.warning("%s can't be renewed: %s", self._claim, error)
            else:
                self._renewed = before

    def _watch(self) -> None:
        while not self._ended.wait(min(1.0, self._lease / 20)):
            if time.monotonic() - self._renewed > self._lease / 2:
                self._lose("it could not be renewed")
                return

    def _lose(self, why: str) -> None:
        if not self._ended.is_set():
            _log.error("%s is lost: %s", self._claim, why)
            self._on_lost()

    def end(self) -> None:
        """Renew it no more."""
        self._ended.set()
        self._renewer.join(self._lease)


def _take(path: Path, token: str, lease: float) -> Path:
    make_folder(path.parent)
    said = False
    while True:
        last = max(_claims(path), default=0)
        try:
            free = not last or _age(before := _numbered(path, last)) >= _lease_of(before, lease)
        except FileNotFoundError:  # it went just now
            continue
        if free:
            claim = _numbered(path, last + 1)
            with suppress(FileExistsError), claim.open("x", encoding="utf-8") as file:
                file.write(token)
                return claim
        elif not said:
            said = True
            _log.warning("waiting: another process is at %s", path)
        time.sleep(min(2.0, lease / 10))


def _claims(path: Path) -> dict[int, Path]:
    """Number -> file of the claims on something."""
    return {int(name.suffix[1:]): name for name in path.parent.glob(f"{path.name}.[0-9]*")}


def _numbered(path: Path, number: int) -> Path:
    return path.with_name(f"{path.name}.{number}")


def _lease_of(claim: Path, default: float = LEASE) -> float:
    """Seconds, as whoever made a claim said; one that was killed at that moment said nothing."""
    try:
        return float(claim.read_text(encoding="utf-8").split(" ")[3])
    except (OSError, ValueError, IndexError):
        return default


def _age(claim: Path) -> float:
    """Seconds since a claim was renewed, by the file server's clock."""
    probe = claim.with_name(f".{uuid.uuid4().hex}.tmp")
    try:
        probe.touch()
        os.utime(probe)
        now = probe.stat().st_mtime
    finally:
        probe.unlink(missing_ok=True)
    with claim.open(encoding="utf-8") as file:  # to open a file asks the server; to look at its name may not
        return now - os.fstat(file.fileno()).st_mtime
