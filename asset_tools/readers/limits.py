"""Limit the time and the memory for reading untrusted files."""

from __future__ import annotations

import re
import resource
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from robocas_ms3.core.errors import AssetError

MAX_SECONDS = 25.0
MAX_MEMORY = 2 * 2**30  # bytes


@contextmanager
def limit_time_and_memory(where: object) -> Iterator[None]:
    """Abort the block after 25 s, or if the block needs more than 2 GB of additional memory.

    The time limit applies only in the main thread, since other threads cannot set an alarm.

    Args:
        where: path of the model, for errors.

    Raises:
        AssetError: a limit was exceeded.
    """
    fix = "Reduce the mesh, or skip the model."
    too_slow = AssetError(
        "reading the model exceeded the time limit", where=where, expected=f"at most {MAX_SECONDS:.0f} s", fix=fix
    )
    limit = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = _data_size() + MAX_MEMORY
    if limit[1] != resource.RLIM_INFINITY:
        wanted = min(wanted, limit[1])
    main_thread = threading.current_thread() is threading.main_thread()
    alarm = _Alarm()
    handler = signal.signal(signal.SIGALRM, alarm.on_signal) if main_thread else None
    try:
        resource.setrlimit(resource.RLIMIT_DATA, (wanted, limit[1]))
        if main_thread:
            signal.setitimer(signal.ITIMER_REAL, MAX_SECONDS)
        yield
    except MemoryError as error:
        what = "reading the model exceeded the memory limit"
        raise AssetError(what, where=where, expected=f"at most {MAX_MEMORY >> 30} GB", fix=fix) from error
    except _Timeout as error:
        raise too_slow from error
    except Exception as error:
        if alarm.rung:  # native code has converted the alarm to another error
            raise too_slow from error
        raise
    finally:
        if main_thread:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_DATA, limit)


class _Timeout(BaseException):
    """Error that ends the block after the time limit; a BaseException, so that parsers do not catch it."""


class _Alarm:
    def __init__(self) -> None:
        self.rung = False

    def on_signal(self, number: int, frame: FrameType | None) -> None:
        self.rung = True
        raise _Timeout


def _data_size() -> int:
    """Return the number of bytes that count towards RLIMIT_DATA."""
    found = re.search(r"^VmData:\s*(\d+) kB", Path("/proc/self/status").read_text(), flags=re.MULTILINE)
    return int(found[1]) * 1024 if found else 0
