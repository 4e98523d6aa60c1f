"""Websocket connections of the client, in an event loop that runs in its own thread; detection of dead peers.

TCP keepalive is on for every connection, and websocket pings are sent where the other end answers them.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket as sockets
import threading
import time
from collections.abc import Coroutine
from functools import cache
from typing import Any, TypeVar

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

from robocas_ms3.core.errors import EvaluationError, WireError
from robocas_ms3.core.words import printable
from robocas_ms3.evaluation.remote.messages import ServerMetadata, read_metadata
from robocas_ms3.evaluation.remote.wire import unpack

_log = logging.getLogger(__name__)
PING_INTERVAL = 10.0  # s
PING_TIMEOUT = 60.0  # s without an answer to a ping
TCP_OPTIONS = {"TCP_KEEPIDLE": 30, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 3}  # s, s, probes without an answer
MAX_REPLY = 16 * 2**20  # bytes
_RETRY_S = 0.2  # between attempts to connect
_CLOSE_S = 1.0  # for a server's answer to a close frame
_LOST = (OSError, EOFError, asyncio.TimeoutError, WebSocketException)
_LOOP_LOCK = threading.Lock()  # for the start of the loop; held during a fork, so that no child inherits it locked
os.register_at_fork(before=_LOOP_LOCK.acquire, after_in_parent=_LOOP_LOCK.release, after_in_child=_LOOP_LOCK.release)
_T = TypeVar("_T")


class ConnectionFailed(EvaluationError):
    """A request to a policy server failed.

    Args:
        reason: one line.
        gone: whether the connection was closed; False: the server is silent, or its answer is invalid.
    """

    def __init__(self, reason: str, *, gone: bool = False) -> None:
        self.gone = gone
        super().__init__(reason)


class Connection:
    """An open connection to a policy server. Open it with `open_connection`; use it inside of `run_in_loop`.

    Attributes:
        metadata: what the server announced.
        envs: envs whose episodes the server knows by this connection.
    """

    def __init__(self, socket: ClientConnection, metadata: ServerMetadata) -> None:
        self._socket, self.metadata = socket, metadata
        self.envs: set[int] = set()
        self._failure = ""
        self._pings = asyncio.ensure_future(self._ping()) if metadata.answers_pings else None

    async def request(self, data: bytes) -> Any:
        """Send a message and return the answer.

        Raises:
            ConnectionFailed: the connection is lost, or the answer is an error text or invalid.
        """
        try:
            await self._socket.send(data)
            answer = await self._socket.recv()
        except _LOST as error:
            raise ConnectionFailed(f"the connection is lost: {self._failure or _line_of(error)}", gone=True) from error
        return _read(answer)

    async def close(self) -> None:
        """Close the connection, within 2 s whatever the server does."""
        if self._pings is not None:
            self._pings.cancel()
        try:
            await asyncio.wait_for(self._socket.close(), 2 * _CLOSE_S)
        except _LOST:
            self._socket.transport.abort()

    async def _ping(self) -> None:
        """Abort the connection when the server does not answer a ping."""
        try:
            while True:
                await asyncio.sleep(PING_INTERVAL)
                answered = await self._socket.ping()
                await asyncio.wait_for(answered, PING_TIMEOUT)
        except asyncio.TimeoutError:
            self._failure = f"no answer to a ping within {PING_TIMEOUT:g} s"
            self._socket.transport.abort()
        except WebSocketException:  # closed
            pass


async def open_connection(url: str, connect_s: float) -> Connection:
    """Connect to a policy server and read its metadata; retry while there is no server.

    Args:
        url: of the server.
        connect_s: time limit, s.

    Raises:
        ConnectionFailed: no server answered in time, or its metadata are an error text or invalid.
        EvaluationError: the metadata have values out of range.
    """
    deadline, warned = time.monotonic() + connect_s, False
    while True:
        try:
            socket, first = await asyncio.wait_for(_open(url), max(deadline - time.monotonic(), 0.01))
            break
        except _LOST as error:
            if deadline - time.monotonic() < _RETRY_S:
                reason = f"no server at {url} within {connect_s:g} s: {_line_of(error)}"
                raise ConnectionFailed(reason, gone=True) from error
            if not warned:
                _log.warning("waiting for a policy server at %s, up to %g s", url, connect_s)
                warned = True
            await asyncio.sleep(_RETRY_S)
    try:
        return Connection(socket, read_metadata(_read(first), url))
    except BaseException:
        socket.transport.abort()
        raise


class AnswerTimer:
    """Limit the time in which no request is answered.

    A server that computes one answer after another may take this time for each of them.

    Args:
        timeout_s: s since the request was sent and since the last answer to any request.
    """

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._last_answer = 0.0

    async def limit(self, request: Coroutine[Any, Any, _T]) -> _T:
        """Return the answer to a request.

        Raises:
            ConnectionFailed: the request failed, or the time is over.
        """
        sent, answer = time.monotonic(), asyncio.ensure_future(request)
        try:
            while not answer.done():
                left = max(sent, self._last_answer) + self._timeout_s - time.monotonic()
                if left <= 0:
                    raise ConnectionFailed(f"no answer within {self._timeout_s:g} s")
                await asyncio.wait({answer}, timeout=left)
            self._last_answer = time.monotonic()
            return answer.result()
        finally:
            answer.cancel()


def enable_tcp_keepalive(connection: Any) -> None:
    """Let the kernel close an idle websocket connection 60 s after the other machine stopped answering.

    The other machine's kernel answers, so a process that is busy keeps its connections. The kernel sends no probes
    while sent data are unacknowledged: pings and ``timeout_s`` detect a network that is lost then. ``TCP_USER_TIMEOUT``
    is not set, as it also closes a connection to a server that reads no data for that time during inference.

    Args:
        connection: a connection of `websockets.asyncio`.
    """
    tcp = connection.transport.get_extra_info("socket")
    tcp.setsockopt(sockets.SOL_SOCKET, sockets.SO_KEEPALIVE, 1)
    for name, value in TCP_OPTIONS.items():
        if hasattr(sockets, name):  # not on every system
            tcp.setsockopt(sockets.IPPROTO_TCP, getattr(sockets, name), value)


def run_in_loop(work: Coroutine[Any, Any, _T]) -> _T:
    """Run a coroutine in the thread of this process's event loop and return its result."""
    with _LOOP_LOCK:
        loop = _loop(os.getpid())
    future = asyncio.run_coroutine_threadsafe(work, loop)
    try:
        return future.result()
    except BaseException:
        future.cancel()
        raise


def error_line(text: str) -> str:
    """Return the last line of a server's error text, which in a traceback names the error."""
    lines = [line for line in text.splitlines() if line.strip()] or ["nothing"]
    return printable(" ".join(lines[-1].split())[:300])


@cache
def _loop(process: int) -> asyncio.AbstractEventLoop:
    """Start the thread of a process's event loop, which answers pings while the caller simulates.

    A forked process has no threads of its parent, so it needs an event loop of its own.
    """
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="robocas-remote", daemon=True).start()
    return loop


async def _open(url: str) -> tuple[ClientConnection, str | bytes]:
    # `websockets` sends no pings here: openpi's server does not answer them during inference.
    socket = await connect(
        url,
        compression=None,
        max_size=MAX_REPLY,
        max_queue=1,
        ping_interval=None,
        close_timeout=_CLOSE_S,
        open_timeout=None,
        proxy=None,
    )
    try:
        enable_tcp_keepalive(socket)
        return socket, await socket.recv()
    except BaseException:
        socket.transport.abort()
        raise


def _read(message: str | bytes) -> Any:
    if isinstance(message, str):
        raise ConnectionFailed(f"the server failed: {error_line(message)}")
    try:
        return unpack(message, MAX_REPLY)
    except WireError as error:
        raise ConnectionFailed(f"the server sent an invalid message: {error}") from error


def _line_of(error: BaseException) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:300]
