"""Serve a policy over websockets, to our clients and openpi's."""

from __future__ import annotations

import asyncio
import http
import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from queue import SimpleQueue
from typing import Any

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from robocas_ms3 import __version__
from robocas_ms3.core.errors import EvaluationError, RobocasError, WireError
from robocas_ms3.core.words import error_line
from robocas_ms3.evaluation.policy import Policy, describe, policy_code, policy_spec_values
from robocas_ms3.evaluation.remote import connection
from robocas_ms3.evaluation.remote.address import netloc, strip_brackets
from robocas_ms3.evaluation.remote.answers import Answers, ServedFiles
from robocas_ms3.evaluation.remote.messages import DEFAULT_BATCH, ServerMetadata, batch_limit, message_bytes
from robocas_ms3.evaluation.remote.wire import pack

HEALTH = "/healthz"
MAX_CONNECTIONS = 256
_log = logging.getLogger(__name__)
_IDLE = 3600.0  # s without a message, after which a connection is closed
_STOP_S = 5.0  # for the network's thread to end
_FAILED, _GARBAGE, _FULL = 1011, 1008, 1013  # close codes


class PolicyServer:
    """Serve a policy: one request after another, in the thread that calls `run`.

    So the policy stays in the thread that made it, and Ctrl-C reaches its code. A second thread does the network's
    work: it answers pings and ``/healthz`` during inference.

    Args:
        policy: that acts.
        host: address to listen on. There is no password: everyone who can reach the address can use the policy.
        port: 0: a free one.
        files: that clients may choose; default: those of shipped protocols.
        max_batch: number of envs that a batched request may have; fewer where their images exceed a message's size.
    """

    def __init__(
        self,
        policy: Policy,
        host: str = "127.0.0.1",
        port: int = 8000,
        files: ServedFiles | None = None,
        max_batch: int = DEFAULT_BATCH,
    ) -> None:
        self._host, self._port = strip_brackets(host), port
        with policy_code(policy):
            spec = policy.spec
        max_batch = batch_limit(spec, max_batch)
        self._max_bytes = message_bytes(spec, max_batch)
        about = {**describe(policy), "robocas_ms3": __version__}
        metadata = ServerMetadata(
            robocas_wants=policy_spec_values(spec),
            robocas_policy=about,
            robocas_max_batch=max_batch,
            robocas_answers_pings=True,
        )
        self._metadata = pack(metadata.model_dump(by_alias=True))
        self._answers = Answers(policy, files or ServedFiles.of(), self._max_bytes, max_batch)
        self._calls: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._connections = 0

    def run(self, listening: Callable[[str], object] = lambda url: None) -> None:
        """Serve until `stop`; ``listening`` is called with the server's address as soon as it can be reached.

        Raises:
            EvaluationError: it can't listen there.
        """
        started: Future[tuple[str, Callable[[], object]]] = Future()
        network = threading.Thread(target=self._serve, args=(started,), name="robocas-server", daemon=True)
        network.start()
        url, end = started.result()
        try:
            listening(url)
            while call := self._calls.get():
                future, work = call
                if future.set_running_or_notify_cancel():  # the client is still there
                    future.set_result(work())
        finally:
            end()
            network.join(_STOP_S)

    def stop(self) -> None:
        """End `run`, from another thread, after the requests that it has received."""
        self._calls.put(None)

    def _serve(self, started: Future[tuple[str, Callable[[], object]]]) -> None:
        """Run the network's event loop."""
        try:
            asyncio.run(self._listen(started))
        except Exception as error:
            if started.done():
                _log.exception("the server's network thread failed")
            else:
                started.set_exception(error)
        finally:
            self.stop()

    async def _listen(self, started: Future[tuple[str, Callable[[], object]]]) -> None:
        loop, ended = asyncio.get_running_loop(), asyncio.Event()
        server = serve(
            self._talk,
            self._host,
            self._port,
            process_request=_health,
            origins=[None],  # no web page may talk to a server on its reader's machine
            compression=None,
            max_size=self._max_bytes,
            max_queue=1,
            ping_interval=connection.PING_INTERVAL,
            ping_timeout=connection.PING_TIMEOUT,
            close_timeout=1,
        )
        try:
            running = await server
        except (OSError, UnicodeError) as error:
            raise EvaluationError("can't listen", where=netloc(self._host, self._port), found=error) from error
        async with running:
            port = next(iter(running.sockets)).getsockname()[1]
            url = f"ws://{netloc(self._host, port)}"
            started.set_result((url, lambda: loop.call_soon_threadsafe(ended.set)))
            await ended.wait()

    async def _talk(self, client: ServerConnection) -> None:
        if self._connections >= MAX_CONNECTIONS:
            return await client.close(_FULL, "too many clients")
        self._connections += 1
        connection.enable_tcp_keepalive(client)
        envs: dict[int, int] = {}  # the client's to the policy's
        closed = asyncio.ensure_future(client.wait_closed())
        try:
            await client.send(self._metadata)
            while True:
                message = await asyncio.wait_for(client.recv(), _IDLE)
                reply = asyncio.wrap_future(self._submit(partial(self._reply, message, envs)))
                await asyncio.wait({reply, closed}, return_when=asyncio.FIRST_COMPLETED)
                if not reply.done():  # the client closed the connection
                    reply.cancel()
                    return
                answer, code = reply.result()
                await client.send(answer)
                if code:
                    return await client.close(code)
        except (ConnectionClosed, asyncio.TimeoutError):
            pass
        finally:
            closed.cancel()
            self._connections -= 1
            self._submit(partial(self._answers.release, envs))

    def _submit(self, work: Callable[[], Any]) -> Future[Any]:
        """Have the thread of `run` call a function."""
        future: Future[Any] = Future()
        self._calls.put((future, work))
        return future

    def _reply(self, message: str | bytes, envs: dict[int, int]) -> tuple[str | bytes, int]:
        """Return an answer, and the code to close the connection with; 0: it stays open."""
        try:
            return pack(self._answers.answer(message, envs)), 0
        except WireError as error:
            _log.warning("a client sent an invalid message: %s", error)
            return error_line(error, 300), _GARBAGE
        except RobocasError as error:
            _log.warning("the policy failed: %s", error)
            return error_line(error, 300), _FAILED
        except Exception as error:  # a policy may raise anything; other clients are still served
            _log.exception("the policy failed")
            return error_line(error, 300), _FAILED


def _health(client: ServerConnection, request: Request) -> Response | None:
    return client.respond(http.HTTPStatus.OK, "OK\n") if request.path == HEALTH else None
