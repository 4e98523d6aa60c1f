"""Detect dead peers: TCP keepalive for every connection, websocket pings where the other end answers them."""

from __future__ import annotations

import socket
from typing import Any

PING_INTERVAL = 10.0  # s
PING_TIMEOUT = 60.0  # s without an answer to a ping
TCP_OPTIONS = {"TCP_KEEPIDLE": 30, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 3}  # s, s, probes without an answer


def enable_tcp_keepalive(connection: Any) -> None:
    """Let the kernel close an idle websocket connection 60 s after the other machine stopped answering.

    The other machine's kernel answers, so a process that is busy keeps its connections. The kernel sends no probes
    while sent data are unacknowledged: pings and ``timeout_s`` detect a network that is lost then. ``TCP_USER_TIMEOUT``
    is not set, as it also closes a connection to a server that reads no data for that time during inference.

    Args:
        connection: a connection of `websockets.asyncio`.
    """
    tcp = connection.transport.get_extra_info("socket")
    tcp.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in TCP_OPTIONS.items():
        if hasattr(socket, name):  # not on every system
            tcp.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
