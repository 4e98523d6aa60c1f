"""Turns what PhysX only prints, that it ran out of memory and dropped contacts, into an error of ours."""

from __future__ import annotations

import os
import re
import threading
import weakref

from robocas_ms3.errors import SimulationError

_TELLS = re.compile(
    rb"[^\n]*(?:overflow|PxgPinnedHostLinearMemoryAllocator|increase (?:its size|capacity))[^\n]*", re.I
)
_LONGEST_LINE = 4096  # bytes that are kept until their line is complete
_FIX = (
    "Contacts were lost, so results are worth nothing. Use fewer envs, or more memory: "
    "sim_config=dict(gpu_memory_config=dict(max_rigid_contact_count=2**23, max_rigid_patch_count=2**21))."
)


class EngineErrors:
    """Listens to the process's standard error, and passes everything on.

    PhysX goes on without the contacts that it had no room for, and says so there and nowhere else.
    """

    def __init__(self) -> None:
        source, sink = os.pipe()
        passed_on = os.dup(2)
        os.dup2(sink, 2)
        pipe = os.fstat(sink)
        os.close(sink)
        self._found: list[str] = []
        listener = threading.Thread(target=_listen, args=(source, passed_on, self._found), daemon=True)
        listener.start()
        self._finalizer = weakref.finalize(self, _restore, passed_on, pipe, listener)

    def close(self) -> None:
        """Give standard error back."""
        self._finalizer()

    def check(self) -> None:
        """Raise what has been heard so far.

        Raises:
            SimulationError: the engine ran out of memory.
        """
        if self._found:
            raise SimulationError("PhysX ran out of memory on the GPU", found=self._found.pop(), fix=_FIX)


def _listen(source: int, passed_on: int, found: list[str]) -> None:
    line = b""
    while heard := os.read(source, 65536):
        _write(passed_on, heard)
        *lines, line = (line + heard).split(b"\n")
        line = line[-_LONGEST_LINE:]
        found += [tell.group().decode(errors="replace").strip() for text in lines if (tell := _TELLS.match(text))]
    os.close(source)


def _write(file: int, data: bytes) -> None:
    while data:
        data = data[os.write(file, data) :]


def _restore(passed_on: int, pipe: os.stat_result, listener: threading.Thread) -> None:
    """Give standard error back, unless somebody has replaced it meanwhile.

    The listener then finds the end of its pipe; where a child process still holds that, it is not waited for.
    """
    if os.path.samestat(os.fstat(2), pipe):
        os.dup2(passed_on, 2)
    listener.join(timeout=0.5)
    if not listener.is_alive():
        os.close(passed_on)
