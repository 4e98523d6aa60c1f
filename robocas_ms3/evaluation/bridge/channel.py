"""Messages over a socket between a process and the one that started it: 8 bytes of length, then msgpack (`wire`)."""

from __future__ import annotations

import os
import select
import socket
from typing import Any

from robocas_ms3.errors import WireError
from robocas_ms3.evaluation.remote.wire import MAX_BYTES, pack, unpack
from robocas_ms3.processes import leave_with

_LENGTH = 8  # bytes, most significant first
_LOOK = 1.0  # s


class Channel:
    """One end.

    Args:
        end: of a pair of sockets.
    """

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    def send(self, message: dict[str, Any]) -> None:
        """Send a message; see `wire.pack` for what it may hold."""
        data = pack(message)
        self._end.sendall(len(data).to_bytes(_LENGTH, "big") + data)

    def receive(self) -> dict[str, Any]:
        """Wait for a message.

        Raises:
            EOFError: the other end is closed.
            WireError: it is none.
        """
        length = int.from_bytes(self._read(_LENGTH), "big")
        if length > MAX_BYTES:
            raise WireError("a message is too large", expected=f"{MAX_BYTES} bytes at most", found=length)
        message = unpack(self._read(length))
        if not isinstance(message, dict):
            raise WireError("no message", expected="a map", found=type(message).__name__)
        return message

    def _read(self, count: int) -> bytes:
        parts = bytearray()
        while len(parts) < count:
            part = self._end.recv(min(count - len(parts), 2**20))
            if not part:
                raise EOFError
            parts += part
        return bytes(parts)


def leave_with_starter(end: socket.socket, starter: int) -> None:
    """End this process as soon as the other end is closed, or its starter is no more, whatever it is at.

    Args:
        end: of the pair of sockets; forks of the starter may keep the other one open.
        starter: its process id; a script between the two may be the parent.
    """
    poll = select.poll()
    poll.register(end.fileno(), 0)  # nothing but hang-ups
    leave_with(os.getppid(), lambda: poll.poll(1000 * _LOOK) or not _is_there(starter))


def _is_there(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
