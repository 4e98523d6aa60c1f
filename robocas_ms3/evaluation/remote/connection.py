"""Addresses of policy servers, connections to them, and detection of unreachable peers.

Both ends use TCP keepalive, and send websocket pings to peers that answer pings.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import time
from dataclasses import dataclass, field, fields
from typing import Annotated, Any
from urllib.parse import parse_qsl, urlsplit, urlunsplit

from pydantic import ConfigDict, Field, PositiveInt, TypeAdapter, ValidationError
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

from robocas_ms3.core.errors import EvaluationError, WireError
from robocas_ms3.core.strict_model import error_from_validation
from robocas_ms3.core.text import one_line
from robocas_ms3.evaluation.policy import PolicySpec
from robocas_ms3.evaluation.remote.messages import ServerMetadata, parse_metadata
from robocas_ms3.evaluation.remote.wire import decode_message

PING_INTERVAL = 10.0  # s
PING_TIMEOUT = 60.0  # s without an answer to a ping
TCP_OPTIONS = {"TCP_KEEPIDLE": 30, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 3}  # s, s, probes without an answer
MAX_ANSWER = 16 * 2**20  # bytes
CONNECTION_ERRORS = (OSError, EOFError, asyncio.TimeoutError, WebSocketException)
"""Errors of a connection that was closed or cannot be opened."""
_RETRY_S = 0.2  # s between attempts to connect
_CLOSE_S = 1.0  # s to wait for the answer to a close frame
_log = logging.getLogger(__name__)
_Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Text = Annotated[str, Field(min_length=1)]


@dataclass(frozen=True)
class PolicyAddress:
    """Address of a policy server with its options.

    Attributes:
        url: address without options.
        spec: specification of the policy, for servers that do not announce one; None: not given.
        rename: by name of a camera or quantity, such as ``qpos`` or ``prompt``, the key in messages.
        n_action_steps: number of actions of a chunk to execute before the next request; None: all actions.
        max_in_flight: maximum number of unanswered requests, for servers without batches; None: one per env.
        timeout_s: time limit for the answer to a request, s.
        connect_s: time limit to open a connection when an episode starts, s.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    url: str
    spec: PolicySpec | None = None
    rename: dict[_Text, _Text] = field(default_factory=dict)
    n_action_steps: PositiveInt | None = None
    max_in_flight: PositiveInt | None = None
    timeout_s: _Seconds = 120.0
    connect_s: _Seconds = 30.0


_ADDRESS_ADAPTER = TypeAdapter(PolicyAddress)


def parse_address(text: str) -> PolicyAddress:
    """Parse the address of a policy server, ``ws://host:port?option=value&...``.

    The options are the fields of `PolicySpec` and of `PolicyAddress`. Two options are lists of pairs:
    ``cameras=base_camera:224x224,gripper_camera:224x224`` (width x height) and
    ``rename=base_camera:observation/image,qpos:observation/state``.

    Raises:
        EvaluationError: the address or an option is invalid.
    """
    try:
        parts = urlsplit(text)
        valid = parts.scheme in ("ws", "wss") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # invalid brackets or port
        valid = False
    if not valid:
        raise EvaluationError("invalid policy address", where=text, expected="ws://host:port or ws://[::1]:port")
    options: dict[str, Any] = dict(parse_qsl(parts.query, keep_blank_values=True))
    for name in options.keys() & {"cameras", "rename"}:
        options[name] = {key: value for key, _, value in (pair.partition(":") for pair in options[name].split(","))}
    if "cameras" in options:
        options["cameras"] = {camera: size.split("x") for camera, size in options["cameras"].items()}
    spec = {name: options.pop(name) for name in options.keys() & {one.name for one in fields(PolicySpec)}}
    url = urlunsplit((parts.scheme, parts.netloc, parts.path, "", ""))
    try:
        return _ADDRESS_ADAPTER.validate_python({**options, "url": url, "spec": spec or None})
    except ValidationError as problem:
        raise error_from_validation(
            problem, _ADDRESS_ADAPTER, EvaluationError, where=text, about="invalid policy address"
        ) from problem


def enable_tcp_keepalive(connection: Any) -> None:
    """Enable TCP keepalive: an idle connection closes 60 s after the other machine stops answering.

    The kernel of the other machine answers the keepalive probes, so a busy process keeps its connections. While sent
    data are unacknowledged, the kernel sends no probes; then pings and ``timeout_s`` detect a lost network.
    ``TCP_USER_TIMEOUT`` is not set, because it would close connections to a server that reads no data during inference.
    """
    tcp = connection.transport.get_extra_info("socket")
    tcp.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in TCP_OPTIONS.items():
        if hasattr(socket, name):  # some systems lack the option
            tcp.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


async def open_connection(url: str, connect_s: float, *, pings: bool) -> tuple[ClientConnection, ServerMetadata]:
    """Connect to a policy server and return the connection and the metadata of the server.

    Args:
        url: address without options.
        connect_s: time in s for which the connection is tried again.
        pings: whether to send websocket pings; only for servers that answer pings during inference.

    Raises:
        EvaluationError: no connection within ``connect_s``, or invalid metadata.
    """
    deadline, warned = time.monotonic() + connect_s, False
    while True:
        try:
            connection, first = await asyncio.wait_for(_handshake(url, pings), max(deadline - time.monotonic(), 0.01))
            break
        except CONNECTION_ERRORS as error:
            if deadline - time.monotonic() < _RETRY_S:
                what, fix = (
                    f"no connection to the policy server within {connect_s:g} s",
                    "Start the server, then repeat this command.",
                )
                raise EvaluationError(what, where=url, found=one_line(error, 300), fix=fix) from error
            if not warned:
                _log.warning("waiting up to %g s for the policy server at %s", connect_s, url)
                warned = True
            await asyncio.sleep(_RETRY_S)
    try:
        return connection, parse_metadata(decode_server_message(first), url)
    except EvaluationError:
        await close_connection(connection)
        raise


async def close_connection(connection: ClientConnection) -> None:
    """Close a connection within 2 s, even if the server does not answer."""
    try:
        await asyncio.wait_for(connection.close(), 2 * _CLOSE_S)
    except CONNECTION_ERRORS:
        connection.transport.abort()


def decode_server_message(message: str | bytes) -> Any:
    """Decode a message that a server sent.

    Raises:
        EvaluationError: the message is invalid, or it is a text, which is an error of the server.
    """
    if isinstance(message, str):
        raise make_server_error(message)
    try:
        return decode_message(message, MAX_ANSWER)
    except WireError as error:
        raise EvaluationError(f"the policy server sent an invalid message: {error}") from error


def make_server_error(text: str) -> EvaluationError:
    """Return the error for a text that a server sent, such as a traceback; the last line is the message."""
    lines = [line for line in text.splitlines() if line.strip()] or ["no message"]
    return EvaluationError(f"the policy server failed: {one_line(lines[-1], 300)}")


async def _handshake(url: str, pings: bool) -> tuple[ClientConnection, str | bytes]:
    connection = await connect(
        url,
        compression=None,
        max_size=MAX_ANSWER,
        max_queue=1,
        ping_interval=PING_INTERVAL if pings else None,
        ping_timeout=PING_TIMEOUT,
        close_timeout=_CLOSE_S,
        open_timeout=None,
        proxy=None,
    )
    try:
        enable_tcp_keepalive(connection)
        return connection, await connection.recv()
    except BaseException:
        connection.transport.abort()
        raise
