"""Turns what PhysX only prints, that it ran out of memory and dropped contacts, into an error of ours."""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
from contextlib import suppress
from typing import IO

from robocas_ms3.core.errors import SimulationError

_TELLS = re.compile(
    rb"\[SAPIEN\].*\[(?:critical|error)\].*"
    rb"(?:overflow|to increase|increase (?:its size|capacity)|miss interactions|Internal CUDA error).*",
    re.IGNORECASE,
)
_FIX = (
    "Contacts were lost, so results are worth nothing. Use fewer envs, or give what it names more room, such as "
    "sim_config=dict(gpu_memory_config=dict(max_rigid_contact_count=2**23)); see docs/batched.md."
)


class EngineErrors:
    """Reads what the process writes to standard error, which is passed on as it comes.

    PhysX goes on without the contacts that it had no room for, and says so there and nowhere else. The passing-on is
    done by ``tee``: it goes on where this process crashes or waits.
    """

    def __init__(self) -> None:
        self._log = _tee.open()
        self._open = True

    def check(self) -> None:
        """Raise what has been written since the last check.

        Raises:
            SimulationError: an engine of this process ran out of memory.
        """
        if os.fstat(self._log.fileno()).st_size == self._log.tell():
            return
        tells = [line for line in self._log.read().split(b"\n") if _TELLS.search(line)]
        if tells:
            found = tells[0].decode(errors="replace").strip()
            raise SimulationError("PhysX ran out of memory on the GPU", found=found, fix=_FIX)

    def close(self) -> None:
        """Give standard error back, if nobody else listens."""
        if self._open:
            self._open = False
            self._log.close()
            _tee.close()


class _Tee:
    """Standard error on its way through ``tee``, for as long as anybody listens."""

    def __init__(self) -> None:
        self._listeners = 0

    def open(self) -> IO[bytes]:
        """Give the log, at its present end."""
        if self._listeners == 0:
            self._stderr = os.dup(2)
            self._log = tempfile.NamedTemporaryFile(prefix="robocas-stderr-")  # noqa: SIM115  (closed in `close`)
            # a session of its own: an interrupt is meant for this process
            command = ["tee", "-a", self._log.name]
            self._child = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=self._stderr, stderr=self._stderr, start_new_session=True
            )
            assert self._child.stdin is not None
            self._pipe = os.fstat(self._child.stdin.fileno())
            os.dup2(self._child.stdin.fileno(), 2)
            self._child.stdin.close()
        self._listeners += 1
        log = open(self._log.name, "rb", buffering=0)  # noqa: SIM115  (the listener's)
        log.seek(0, os.SEEK_END)
        return log

    def close(self) -> None:
        """One listener less; the last one gives standard error back, unless somebody has replaced it meanwhile."""
        self._listeners -= 1
        if self._listeners > 0:
            return
        if os.path.samestat(os.fstat(2), self._pipe):
            os.dup2(self._stderr, 2)
        with suppress(subprocess.TimeoutExpired):  # a child process may have the pipe for longer
            self._child.wait(timeout=1.0)
        os.close(self._stderr)
        self._log.close()


_tee = _Tee()
