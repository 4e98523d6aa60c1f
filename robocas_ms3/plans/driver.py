"""Who runs a plan: one process at a time, and by which run of it units may be done.

A run has an id, which lies in the plan's folder as long as the run is at units. Jobs that wait in a queue get it too,
and leave where it is another one by then: they may be of a run that was killed, even of another plan in this folder.
A job first claims a unit and then looks; whoever begins a run first writes its id and then looks for claims. So one
of them sees the other.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

from robocas_ms3.core.documents import DocumentError, load_json
from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.files import write_json
from robocas_ms3.plans.claims import LEASE, age_of, claimed, claims_of, is_of_here, lease_of, read_claim
from robocas_ms3.plans.units import DRIVER

RUN = f"{DRIVER}.run"
_LONGEST = 3600.0  # s that a file may have this process wait for
_SEEN = 10.0  # s that a file may take until another machine sees it
_log = logging.getLogger(__name__)


@contextmanager
def sole(path: Path, lease: float = LEASE, *, locked: bool = True) -> Iterator[None]:
    """Hold the claim on what only one process may do, and end this one if it is lost; see `claimed`.

    Args:
        path: of the claims.
        lease: s.
        locked: whether a lock tells already that nobody else of this machine is there: then a claim of its own is one
            that was killed.

    Raises:
        PlanError: another process holds it.
    """
    known = claims_of(path)
    refuse_other(path, locked=locked)
    for old in known.values():
        with suppress(FileNotFoundError):
            os.utime(old, (0, 0))
    # where the folder is gone there is nothing left to guard, and who works there says so
    with claimed(path, lease, on_gone=lambda: None, stays=False):
        for old in known.values():
            old.unlink(missing_ok=True)
        yield


def refuse_other(path: Path, *, locked: bool = True) -> None:
    """See that nobody else holds a claim; parameters of `sole`.

    Raises:
        PlanError: somebody does.
    """
    claims = claims_of(path)
    if not claims:
        return
    claim = claims[max(claims)]
    with suppress(FileNotFoundError):
        text = read_claim(claim)
        if not text:
            time.sleep(1.0)  # where files can't be linked, one that is made now is empty for a moment
            text = read_claim(claim)
        here, lease = is_of_here(text), lease_of(claim)
        if not text or (here and locked):
            return
        if claim.stat().st_mtime > 0 and (age := age_of(claim)) < lease:
            what = f"another {'process' if here else 'machine'} runs this plan"
            found = f"{text.split(' ')[0]}, {age:.0f} s ago"
            fix = f"Wait until it is done, or was dead for {lease:.0f} s."
            raise PlanError(what, where=path.parent, found=found, fix=fix)


def who_runs(path: Path) -> str | None:
    """The machine of a claim that is held; None: nobody holds it."""
    claims = claims_of(path)
    with suppress(OSError):
        claim = claims[max(claims, default=0)] if claims else None
        if claim and time.time() - claim.stat().st_mtime < lease_of(claim):  # writes nothing to ask the file server
            return read_claim(claim).split(" ")[0] or None
    return None


class Run:
    """A run, by its id.

    Args:
        out: the plan's folder.
        name: the id.
    """

    def __init__(self, out: Path, name: str) -> None:
        self._path, self.name = out / RUN, name

    def write(self, lingers: float = 0.0) -> None:
        """Make it the current one.

        Args:
            lingers: s that what it began may go on for after this process was killed.
        """
        write_json(self._path, {"run": self.name, "lingers": lingers})

    def end(self) -> None:
        """Let it be the current one no more: what waits in a queue yet leaves by itself."""
        with suppress(OSError):
            if _read(self._path.parent).get("run") == self.name:
                self._path.unlink()


@contextmanager
def new_run(out: Path) -> Iterator[Run]:
    """Begin a run, which is the current one inside."""
    run = Run(out, uuid4().hex)
    run.write()
    try:
        yield run
    finally:
        run.end()


def current_run(out: Path) -> Run | None:
    """The one that a folder is of now."""
    name = _read(out).get("run")
    return Run(out, name) if name else None


def is_current(out: Path, name: str | None, seconds: float = _SEEN) -> bool:
    """Whether a run is the one that a folder is of now; that it isn't is looked at for some seconds."""
    until = time.monotonic() + seconds
    while True:
        with suppress(OSError):
            os.listdir(out)  # which asks the file server; whether a file exists may not
        if _read(out).get("run") == name:
            return True
        if time.monotonic() > until:
            return False
        time.sleep(min(0.5, seconds))


def wait_for_killed(out: Path) -> None:
    """Wait until what a run began elsewhere has ended, if the run was killed a moment ago."""
    claims, lingers = claims_of(out / DRIVER), _read(out).get("lingers")
    if not claims or not isinstance(lingers, float) or not 0 < lingers <= _LONGEST:
        return
    claim = claims[max(claims)]
    with suppress(FileNotFoundError):
        if claim.stat().st_mtime > 0:
            most = lingers + lease_of(claim) / 10  # it was renewed so long before, at most
            left = min(most, most - age_of(claim))
            if left > 0:
                _log.warning("waiting for %.0f s: what a killed run began may be at %s yet", left, out)
                time.sleep(left)


def _read(out: Path) -> dict[str, Any]:
    try:
        about = load_json(out / RUN)
    except (OSError, DocumentError):
        return {}
    return about if isinstance(about, dict) and isinstance(about.get("run"), str) else {}
