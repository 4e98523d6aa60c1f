"""Lets a policy answer over a socket: clients of ours, and openpi's."""

from __future__ import annotations

import asyncio
import http
import itertools
import json
import logging
from collections.abc import Callable
from typing import Any

import numpy as np
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from robocas_ms3 import __version__
from robocas_ms3.errors import EvaluationError, RobocasError, WireError
from robocas_ms3.evaluation.policy import Policy, describe, policy_code, said_of
from robocas_ms3.evaluation.remote.address import netloc, strip_brackets
from robocas_ms3.evaluation.remote.messages import (
    ACTIONS,
    ENV,
    POLICY,
    RESET,
    WANTS,
    message_bytes,
    observations_of,
    one_line,
    start_of,
)
from robocas_ms3.evaluation.remote.served import ServedFiles
from robocas_ms3.evaluation.remote.wire import pack, unpack

_LOG = logging.getLogger(__name__)
HEALTH = "/healthz"
MAX_CONNECTIONS = 256
_MAX_ENVS = 1024  # of all connections
_IDLE = 3600.0  # s after which a client that says nothing is taken for gone
_FAILED, _GARBAGE, _FULL = 1011, 1008, 1013  # close codes


class PolicyServer:
    """Asks its policy what clients ask for, one after another, in the thread that it runs in.

    The policy meets each env of each client as an env of its own, alone in its batch. Clients that say neither
    ``env_id`` nor ``reset``, such as openpi's, play one episode a connection.

    Args:
        policy: that acts.
        host: to listen on; there is no password, so others than loopback let in whoever can reach it.
        port: 0: any that is free.
        files: that clients may choose; default: those of shipped protocols.
    """

    def __init__(
        self, policy: Policy, host: str = "127.0.0.1", port: int = 8000, files: ServedFiles | None = None
    ) -> None:
        self._policy, self._host, self._port = policy, strip_brackets(host), port
        self._files = files or ServedFiles.of()
        with policy_code(policy):
            self._wants = policy.wants
        self._max_bytes = message_bytes(self._wants)
        about = json.loads(json.dumps({**describe(policy), "robocas_ms3": __version__}, default=str))
        self._metadata = pack({WANTS: said_of(self._wants), POLICY: about})
        self._taken: set[int] = set()  # envs of the policy
        self._connections = 0
        self._stopping: Callable[[], Any] = lambda: None

    def run(self, listening: Callable[[str], object] = lambda url: None) -> None:
        """Serve until `stop`.

        Args:
            listening: is called with the server's address as soon as it can be reached.

        Raises:
            EvaluationError: it can't listen there.
        """
        asyncio.run(self._run(listening))

    def stop(self) -> None:
        """End `run`, from another thread."""
        self._stopping()

    async def _run(self, listening: Callable[[str], object]) -> None:
        loop, ended = asyncio.get_running_loop(), asyncio.Event()
        self._stopping = lambda: loop.call_soon_threadsafe(ended.set)
        server = serve(
            self._talk,
            self._host,
            self._port,
            process_request=_health,
            origins=[None],  # no web page may talk to a server on its reader's machine
            compression=None,
            max_size=self._max_bytes,
            max_queue=1,
            ping_interval=None,  # who waits for a policy can't answer in time
            close_timeout=1,
        )
        try:
            running = await server
        except (OSError, UnicodeError) as error:
            raise EvaluationError("can't listen", where=netloc(self._host, self._port), found=error) from error
        async with running:
            port = next(iter(running.sockets)).getsockname()[1]
            listening(f"ws://{netloc(self._host, port)}")
            await ended.wait()

    async def _talk(self, client: ServerConnection) -> None:
        if self._connections >= MAX_CONNECTIONS:
            return await client.close(_FULL, "too many clients")
        self._connections += 1
        envs: dict[int, int] = {}  # the client's to the policy's
        try:
            await client.send(self._metadata)
            while True:
                message = await asyncio.wait_for(client.recv(), _IDLE)
                reply, code = self._reply(message, envs)
                await client.send(reply)
                if code:
                    return await client.close(code)
        except (ConnectionClosed, asyncio.TimeoutError):
            pass
        finally:
            self._connections -= 1
            self._taken -= set(envs.values())

    def _reply(self, message: str | bytes, envs: dict[int, int]) -> tuple[str | bytes, int]:
        """An answer, and the code to hang up with; 0: go on."""
        try:
            return pack({ACTIONS: self._actions(message, envs)}), 0
        except WireError as error:
            _LOG.warning("a client sent garbage: %s", error)
            return one_line(error), _GARBAGE
        except RobocasError as error:
            _LOG.warning("the policy failed: %s", error)
            return one_line(error), _FAILED
        except Exception as error:  # whatever a policy raises, its client is to hear of it, and others are to be served
            _LOG.exception("the policy failed")
            return one_line(error), _FAILED

    def _actions(self, data: str | bytes, envs: dict[int, int]) -> np.ndarray:
        message = unpack(data, self._max_bytes) if isinstance(data, bytes) else None
        if not isinstance(message, dict):
            raise WireError("no observation", expected="a map")
        said, resets = message.get(ENV, 0), message.get(RESET)
        if type(said) is not int or not (resets is None or isinstance(resets, bool)):
            raise WireError("no observation", expected=f"a number {ENV}, and whether to {RESET}")
        if said not in envs:
            if resets is False:
                raise WireError("no episode has begun", where=f"{ENV} {said}", expected=RESET)
            if len(self._taken) >= _MAX_ENVS:
                raise WireError("too many envs", expected=f"{_MAX_ENVS} at most")
            resets, envs[said] = True, next(env for env in itertools.count() if env not in self._taken)
            self._taken.add(envs[said])
        env = envs[said]
        observations = observations_of(message, env, self._wants)
        start = start_of(message, env, self._files) if resets else None
        with policy_code(self._policy):
            if start is not None:
                self._policy.reset([start])
            acted = np.asarray(self._policy.act(observations))
        return acted[0][None] if acted.ndim == 2 else acted[0]


def _health(client: ServerConnection, request: Request) -> Response | None:
    return client.respond(http.HTTPStatus.OK, "OK\n") if request.path == HEALTH else None
