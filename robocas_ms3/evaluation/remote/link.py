"""One connection to a server: everything ends within a time, and whatever goes wrong is a `LinkBroken`."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Coroutine
from concurrent.futures import Future, wait
from functools import cache
from typing import Any

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

from robocas_ms3.errors import EvaluationError, WireError
from robocas_ms3.evaluation.remote.wire import unpack

MAX_REPLY = 16 * 2**20  # bytes
_PAUSE = 0.2  # s between attempts to connect
_BROKEN = (OSError, EOFError, asyncio.TimeoutError, WebSocketException)


class LinkBroken(EvaluationError):
    """A server can't be talked to.

    Args:
        reason: in a few words.
        gone: whether the connection was closed; False: the server is silent, or says what it should not.
    """

    def __init__(self, reason: str, *, gone: bool = False) -> None:
        self.gone = gone
        super().__init__(reason)


class Link:
    """A connection.

    Args:
        url: of the server.
        connect_s: how long to go on trying, s.

    Raises:
        LinkBroken: nobody is there, or nobody who speaks like a policy.
    """

    def __init__(self, url: str, connect_s: float) -> None:
        deadline = time.monotonic() + connect_s
        while True:
            left = deadline - time.monotonic()
            try:
                self._socket, first = _wait(_open(url), max(left, 0.01))
                break
            except _BROKEN as error:
                if deadline - time.monotonic() < _PAUSE:
                    raise LinkBroken(
                        f"no server at {url} within {connect_s:g} s: {_words(error)}", gone=True
                    ) from error
                time.sleep(_PAUSE)
        try:
            self.metadata: Any = self._read(first)
        except LinkBroken:
            self.close()
            raise

    def ask(self, data: bytes, timeout_s: float) -> Any:
        """Send a message, and give the answer.

        Raises:
            LinkBroken: there is none within the time, or it is garbage, or says that the server failed.
        """
        try:
            return self._read(_wait(self._exchange(data), timeout_s))
        except asyncio.TimeoutError as error:
            raise LinkBroken(f"no answer within {timeout_s:g} s") from error
        except _BROKEN as error:
            raise LinkBroken(f"the connection is lost: {_words(error)}", gone=True) from error

    def close(self, wait_s: float = 0.0) -> None:
        """Hang up, and wait a while for the other end to notice; it may not."""
        closing = _later(self._socket.close())
        if wait_s:
            wait([closing], wait_s)

    async def _exchange(self, data: bytes) -> str | bytes:
        await self._socket.send(data)
        return await self._socket.recv()

    def _read(self, message: str | bytes) -> Any:
        if isinstance(message, str):  # a traceback, of which the last line says what it was
            lines = [line for line in message.splitlines() if line.strip()] or ["nothing"]
            raise LinkBroken(f"the server failed: {' '.join(lines[-1].split())[:300]}")
        try:
            return unpack(message, MAX_REPLY)
        except WireError as error:
            raise LinkBroken(f"the server sent garbage: {error}") from error


async def _open(url: str) -> tuple[ClientConnection, str | bytes]:
    # No pings: openpi's server can't answer while it thinks. No proxy: servers are near.
    socket = await connect(
        url, compression=None, max_size=MAX_REPLY, ping_interval=None, close_timeout=1, open_timeout=None, proxy=None
    )
    try:
        return socket, await socket.recv()
    except BaseException:
        socket.transport.abort()
        raise


@cache
def _loop() -> asyncio.AbstractEventLoop:
    """A loop in a thread of its own, so that a server's pings are answered while the simulation goes on."""
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="robocas-remote", daemon=True).start()
    return loop


def _later(work: Coroutine[Any, Any, Any]) -> Future[Any]:
    return asyncio.run_coroutine_threadsafe(work, _loop())


def _wait(work: Coroutine[Any, Any, Any], timeout_s: float) -> Any:
    return _later(asyncio.wait_for(work, timeout_s)).result()


def _words(error: BaseException) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:300]
