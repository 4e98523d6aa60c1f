"""The process that simulates: another interpreter, which has robocas_ms3, at the other end of a socket."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import weakref
from pathlib import Path
from typing import IO, Any

import msgpack
import numpy as np

MODULE = "robocas_ms3.evaluation.bridge"
VARIABLE = "ROBOCAS_SIM_PYTHON"
_LENGTH = 8  # bytes of a message's length, most significant first
_MAX_BYTES = 2**32  # of a message
_PATIENCE = 10.0  # s that a process which was told to leave may take
_FIX = (
    f'Install "robocas-ms3[remote]" into an environment of its own, and pass --env.python=THAT/bin/python, or set '
    f"{VARIABLE}."
)


class RoboCASProcessError(RuntimeError):
    """The simulating process can't be had, can't go on, or does not answer."""


class Process:
    """A process that simulates. It leaves when this is closed or collected, or when this process is no more.

    Args:
        python: interpreter that has robocas_ms3; None: see `find_python`.
        asked: the first message.
        timeout_s: clock time an answer may take.

    Raises:
        RoboCASProcessError: it can't do what it is asked for.
    """

    def __init__(self, python: str | None, asked: dict[str, Any], timeout_s: float) -> None:
        self.python = find_python(python)
        self._timeout = timeout_s
        ours, theirs = socket.socketpair()
        log = tempfile.TemporaryFile()  # noqa: SIM115  (of what it prints; its last line is told if it dies)
        command = [self.python, "-W", "ignore", "-m", MODULE, str(theirs.fileno()), str(os.getpid())]
        try:
            child = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=_clean()
            )
        except OSError as error:
            ours.close()
            log.close()
            raise RoboCASProcessError(f"no interpreter at {self.python}: {error.strerror}. {_FIX}") from None
        finally:
            theirs.close()
        ours.settimeout(timeout_s)
        self._end, self._child, self._log = ours, child, log
        self.close = weakref.finalize(self, _end, ours, child, log)
        self.ready: dict[str, Any] = self.ask(asked)["ready"]

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._child.pid

    def ask(self, message: dict[str, Any]) -> dict[str, Any]:
        """Send a message, and give the answer; the process is ended when there is none.

        Raises:
            RoboCASProcessError: it died, did not answer in time, or says why it can't.
        """
        if not self.close.alive:
            raise RoboCASProcessError("the simulating process was closed")
        data: bytes = msgpack.Packer(default=_written).pack(message)
        try:
            self._end.sendall(len(data).to_bytes(_LENGTH, "big") + data)
            answer = self._answer()
        except TimeoutError:
            self._child.kill()
            self.close()
            what = f"the simulating process did not answer within {self._timeout:g} s"
            raise RoboCASProcessError(f"{what}, and was ended. --env.timeout_s=N gives it longer.") from None
        except (EOFError, OSError):
            said = self._last_words()
            self.close()
            raise RoboCASProcessError(said) from None
        except (ValueError, TypeError, KeyError, msgpack.UnpackException) as error:
            self._child.kill()
            self.close()
            what = f"the simulating process sent no message: {' '.join(str(error).split())[:300]}"
            raise RoboCASProcessError(f"{what}. It ran {self.python}. {_FIX}") from None
        if "error" in answer:
            self.close()
            raise RoboCASProcessError(answer["error"])
        return answer

    def _answer(self) -> dict[str, Any]:
        length = int.from_bytes(self._read(_LENGTH), "big")
        if length > _MAX_BYTES:
            raise ValueError(f"{length} bytes, expected {_MAX_BYTES} at most")
        answer = msgpack.unpackb(self._read(length), object_hook=_read, strict_map_key=False, max_bin_len=2**31 - 1)
        if not isinstance(answer, dict):
            raise TypeError(f"expected a map, found {type(answer).__name__}")
        return answer

    def _read(self, count: int) -> bytearray:
        data = bytearray(count)
        view, got = memoryview(data), 0
        while got < count:
            part = self._end.recv_into(view[got:])
            if not part:
                raise EOFError
            got += part
        return data

    def _last_words(self) -> str:
        """Why it died, as far as that is known."""
        try:
            code = self._child.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            return f"the simulating process hung up, and was ended ({self.python})"
        self._log.seek(0)
        lines = [line for line in self._log.read().decode(errors="replace").splitlines() if line.strip()]
        last = " ".join(lines[-1].split())[:300] if lines else "it printed nothing"
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        absent = any(word in last for word in ("No module named", "MissingExtraError", "Error while finding module"))
        return f"the simulating process ended ({how}): {last}. It ran {self.python}. {_FIX if absent else ''}".strip()


def find_python(python: str | None) -> str:
    """The interpreter that has robocas_ms3.

    Args:
        python: as it was asked for; None: $ROBOCAS_SIM_PYTHON, else the one beside the ``robocas`` that the shell would
            find, else this one.
    """
    asked = python or os.environ.get(VARIABLE)
    if asked:
        return os.path.expanduser(asked)
    command = shutil.which("robocas")
    beside = Path(command).parent / "python" if command else None
    return str(beside) if beside is not None and beside.exists() else sys.executable


def _clean() -> dict[str, str]:
    """The environment of another interpreter."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONHOME", "__PYVENV_LAUNCHER__")}


def _end(end: socket.socket, child: subprocess.Popen[bytes], log: IO[bytes]) -> None:
    end.close()  # it leaves by itself
    try:
        child.wait(_PATIENCE)
    except subprocess.TimeoutExpired:
        child.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(_PATIENCE)
    log.close()


def _written(value: Any) -> dict[bytes, Any]:
    """An array as robocas_ms3's ``wire`` has it."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
        raise TypeError(f"a {type(value).__name__}")
    return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}


def _read(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" not in value:
        return value
    return np.frombuffer(value[b"data"], np.dtype(value[b"dtype"])).reshape(value[b"shape"])
