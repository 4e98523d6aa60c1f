"""HTTP server of the viewer, for browsers on this machine only."""

from __future__ import annotations

import socket
import sys
import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

from robocas_ms3.core.errors import RobocasError
from robocas_ms3.core.text import escape_controls, print_traceback
from robocas_ms3.viewer.content import Content
from robocas_ms3.viewer.routes import Response, Routes

HOST = "127.0.0.1"
MAX_CONNECTIONS = 256
_POLICY = "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"


class Viewer(ThreadingHTTPServer):
    """HTTP server of the page of a dataset; a context manager.

    Closing waits for all threads, because the interpreter would crash if it stopped a thread inside OpenCV. Raises
    RobocasError if the port cannot be used.
    """

    daemon_threads = False

    def __init__(self, source: Content, port: int = 0) -> None:
        self.routes = Routes(source)
        self._connections: set[Any] = set()
        self._warming = threading.Thread(target=self.routes.respond, args=("/data/index.js",), daemon=True)
        try:
            super().__init__((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            fix = "Choose another port, or omit --port."
            raise RobocasError("this port can't be used", where=port, found=reason, fix=fix) from error

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.server_port}/"

    def warm_up(self) -> None:
        """Start a thread that computes the content of the table, so that the first request is fast."""
        self._warming.start()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Accept a connection, unless there are too many; each connection has a thread."""
        if len(self._connections) >= MAX_CONNECTIONS:
            return self.shutdown_request(request)
        self._connections.add(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        self._connections.discard(request)
        super().shutdown_request(request)

    def server_close(self) -> None:
        for connection in list(self._connections):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        super().server_close()
        if self._warming.is_alive():
            self._warming.join(5.0)

    def handle_error(self, request: Any, client_address: Any) -> None:
        error = sys.exc_info()[1]
        if error is not None and not isinstance(error, ConnectionError | TimeoutError):
            print_traceback(type(error), error, error.__traceback__)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version = "robocas"
    sys_version = ""
    timeout = 60  # s, for idle connections

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def _answer(self, *, body: bool) -> None:
        assert isinstance(self.server, Viewer)
        response = self._respond(self.server)
        headers = {
            "Content-Type": response.media_type,
            "Content-Length": str(len(response.data)),
            "Cache-Control": f"max-age={response.max_age}" if response.max_age else "no-cache",
            "Content-Security-Policy": _POLICY,
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
        self.send_response(response.status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        if body:
            try:
                self.wfile.write(response.data)
            except (BrokenPipeError, ConnectionResetError):
                self.close_connection = True  # the browser moved on to another step

    def _respond(self, server: Viewer) -> Response:
        # against DNS rebinding: pages of other hosts must not read the dataset
        if self.headers.get("Host") not in {f"{name}:{server.server_port}" for name in (HOST, "localhost")}:
            return Response(403, "text/plain; charset=utf-8", b"only available on this machine\n")
        try:
            return server.routes.respond(urlsplit(self.path).path)
        except Exception as error:  # a damaged episode must not close the connection
            text = escape_controls(f"{type(error).__name__}: {error}") + "\n"
            return Response(500, "text/plain; charset=utf-8", text.encode())

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing, because a page requests thousands of images."""
