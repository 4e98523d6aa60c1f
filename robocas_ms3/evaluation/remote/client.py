"""Remote policy that requests actions from a policy server."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from websockets.asyncio.client import ClientConnection

from robocas_ms3.core.errors import EvaluationError, PolicyError, WireError
from robocas_ms3.core.text import one_line
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.evaluation.remote.connection import (
    CONNECTION_ERRORS,
    close_connection,
    decode_server_message,
    make_server_error,
    open_connection,
    parse_address,
)
from robocas_ms3.evaluation.remote.messages import (
    BATCH,
    ERROR,
    EVALUATION,
    LARGEST_BATCH,
    PREFIX,
    EvaluationAnswer,
    EvaluationFields,
    ServerMetadata,
    check_observations_can_be_sent,
    make_observation_message,
    parse_actions,
    parse_batch,
    parse_evaluation_answer,
    parse_image_request,
    parse_policy_spec,
)
from robocas_ms3.evaluation.remote.wire import encode_message
from robocas_ms3.scenes.config import TaskConfig

_log = logging.getLogger(__name__)
_SHARED = -1  # key of the connection for batched requests; other keys are indices of envs
_T = TypeVar("_T")


class _ConnectionLost(EvaluationError):
    """Error: the connection to the policy server was closed during an episode."""


@dataclass
class _Connection:
    """Connection to a policy server.

    Attributes:
        socket: the websocket.
        envs: indices of the envs whose episodes were started over this connection.
    """

    socket: ClientConnection
    envs: set[int] = field(default_factory=set)


class RemotePolicy:
    """Policy that requests its actions from a policy server, for all envs at the same time.

    - A server that announces ``robocas_max_batch`` gets the observations of all envs in one request.
    - Any other server gets one request per env. Each env has its own connection, and the requests of all envs are sent
      at the same time. The results do not depend on the order in which the answers arrive.
    - If a connection is lost, the episodes that were started over it end with an error. The connection is opened again
      for the next episodes. If this fails, `act` raises an error that ends the evaluation.
    - A forked process must make its own policy: the network thread of the parent does not exist there.

    Args:
        address: ``ws://host:port``, with options (`parse_address`).
    """

    def __init__(self, address: str) -> None:
        self._address = parse_address(address)
        self._loop = asyncio.new_event_loop()  # answers pings while the caller simulates
        self._thread = threading.Thread(target=self._loop.run_forever, name="robocas-remote", daemon=True)
        self._thread.start()
        self._connections: dict[int, _Connection] = {}
        self._starts: dict[int, EpisodeSpec] = {}  # episodes that were not sent to the server yet
        self._image_requests: dict[int, bool] = {}  # by env, of the last answer of its episode
        self._chunk_length: int | None = None
        self._last_answer = 0.0  # clock time, s
        self._metadata = ServerMetadata()
        try:
            self._metadata = self._run_on_network_thread(self._fetch_metadata())
            self.spec: PolicySpec = self._choose_spec(self._metadata)
        except BaseException:
            self.close()
            raise

    def describe(self) -> dict[str, Any]:
        """Return the description that the server announces, and the options ``n_action_steps`` and ``rename``."""
        rename = {"rename": self._address.rename} if self._address.rename else {}
        return {"server": self._metadata.policy, "n_action_steps": self._address.n_action_steps, **rename}

    def check_robot(self, robot: str) -> None:
        """Raise `EvaluationError` if the served policy cannot control the robot with this name."""
        self._check_evaluation(EvaluationFields(robot=robot))

    def protocol_warnings(self, configs: dict[str, TaskConfig]) -> list[str]:
        """Return the warnings of the served policy for the task configurations of an evaluation."""
        return self._check_evaluation(_describe_configs(configs)).warnings

    def list_training_differences(self, configs: dict[str, TaskConfig]) -> dict[str, list[str]] | None:
        """Return by configuration what the training data of the served policy lacks; None: unknown."""
        return self._check_evaluation(_describe_configs(configs)).training_differences

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        """Start episodes. The server gets an episode together with its first observation."""
        self._starts |= {episode.env: episode for episode in episodes}
        for episode in episodes:
            self._image_requests.pop(episode.env, None)

    def requests_images(self, envs: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (E,) bool, whether the server requests images of each env; True for the first observation."""
        return np.array([self._image_requests.get(env, True) for env in envs.tolist()], dtype=bool)

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return action chunks (E, H, A).

        Raises:
            PolicyError: at least one env got no valid actions.
            EvaluationError: no connection to the server.
        """
        envs: list[int] = observations.envs.tolist()
        starts = {env: self._starts.pop(env) for env in envs if env in self._starts}
        messages = [self._make_message(observations, row, starts.get(env)) for row, env in enumerate(envs)]
        answers = self._run_on_network_thread(self._request_actions(envs, messages, set(starts)))
        chunks: dict[int, NDArray[np.float32]] = {}
        reasons: dict[int, str] = {}
        for row, env in enumerate(envs):
            try:
                chunks[row] = self._parse_chunk(answers[row])
                self._image_requests[env] = parse_image_request(answers[row])
            except EvaluationError as error:
                reasons[env] = str(error)
                _log.warning("the episode in env %d ends: %s", env, error)
                self._drop_episode(env)
        if not chunks:
            raise PolicyError(reasons)
        first = next(iter(chunks.values()))
        actions = np.stack([chunks.get(row, np.zeros_like(first)) for row in range(len(envs))])
        if reasons:
            raise PolicyError(reasons, actions)
        return actions

    def close(self) -> None:
        """Close all connections and stop the network thread."""
        if self._loop.is_closed():
            return
        self._run_on_network_thread(self._close(*self._connections))
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _run_on_network_thread(self, coroutine: Coroutine[Any, Any, _T]) -> _T:
        future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def _check_evaluation(self, fields: EvaluationFields) -> EvaluationAnswer:
        if not self._metadata.checks_evaluations:
            return EvaluationAnswer()
        answer = self._run_on_network_thread(self._request_once({EVALUATION: fields.model_dump()}))
        return parse_evaluation_answer(answer, self._address.url)

    async def _request_once(self, message: dict[str, Any]) -> Any:
        """Return the answer to a message that is sent over its own connection."""
        socket, _ = await self._open()
        try:
            return await self._exchange(socket, message)
        finally:
            await close_connection(socket)

    def _make_message(self, observations: Observations, row: int, start: EpisodeSpec | None) -> dict[str, Any]:
        known = start if self._metadata.spec is not None else None  # a plain openpi server does not expect the key
        images = self._image_requests.get(int(observations.envs[row]), True)
        message = make_observation_message(observations, row, known, reset=start is not None, images=images)
        rename = self._address.rename
        return {rename.get(key.removeprefix(PREFIX), key): value for key, value in message.items()}

    def _parse_chunk(self, answer: Any) -> NDArray[np.float32]:
        if isinstance(answer, EvaluationError):
            raise answer
        chunk = parse_actions(answer, self.spec.convention)[: self._address.n_action_steps]
        self._chunk_length = self._chunk_length or len(chunk)
        if len(chunk) != self._chunk_length:
            what, expected = "the length of the action chunks has changed", f"{self._chunk_length} actions"
            raise WireError(what, expected=expected, found=f"{len(chunk)} actions")
        return chunk

    def _drop_episode(self, env: int) -> None:
        """End the episode of an env that got no valid actions; close the connection if only this env uses it."""
        if env in self._connections:
            self._run_on_network_thread(self._close(env))
        elif _SHARED in self._connections:
            self._connections[_SHARED].envs.discard(env)

    async def _request_actions(
        self, envs: list[int], messages: list[dict[str, Any]], starting: set[int]
    ) -> dict[int, Any]:
        """Send one message per env; return the answers or errors by row.

        ``starting``: indices of the envs that start an episode.
        """
        answers: dict[int, Any] = {}
        size = min(self._metadata.max_batch or 1, LARGEST_BATCH)
        slots = asyncio.Semaphore(1 if self._metadata.max_batch else self._address.max_in_flight or len(envs))

        async def request(key: int, rows: list[int]) -> None:
            async with slots:
                answers.update(await self._send_request(key, rows, envs, messages))

        rows = range(len(envs))
        for _ in range(2):  # repeat requests of new episodes once: the server may have restarted
            groups: dict[int, list[int]] = {}
            for row in rows:
                key = _SHARED if self._metadata.max_batch else envs[row]
                known = self._connections[key].envs if key in self._connections else set()
                if envs[row] in known | starting:
                    groups.setdefault(key, []).append(row)
                else:
                    answers[row] = _ConnectionLost("lost connection to the policy server")
            # A plain openpi server accepts no connection during inference, so open all connections first.
            missing = groups.keys() - self._connections.keys()
            await asyncio.gather(*(self._connect(key) for key in missing))
            parts = [(key, group[at : at + size]) for key, group in groups.items() for at in range(0, len(group), size)]
            await asyncio.gather(*(request(key, part) for key, part in parts))
            rows = [row for row in rows if envs[row] in starting and isinstance(answers[row], _ConnectionLost)]
        return answers

    async def _send_request(
        self, key: int, rows: Sequence[int], envs: list[int], messages: list[dict[str, Any]]
    ) -> dict[int, Any]:
        """Send the messages of ``rows`` in one request over a connection; return the answers or errors by row."""
        connection = self._connections.get(key)
        try:
            if connection is None:  # another request has closed it
                raise _ConnectionLost("lost connection to the policy server")
            if self._metadata.max_batch is None:
                answers = [await self._exchange(connection.socket, messages[rows[0]])]
            else:
                answer = await self._exchange(connection.socket, {BATCH: [messages[row] for row in rows]})
                answers = [_actions_or_error(one) for one in parse_batch(answer, len(rows), len(rows))]
        except EvaluationError as error:
            await self._close(key)
            return dict.fromkeys(rows, error)
        connection.envs |= {envs[row] for row in rows}
        return dict(zip(rows, answers, strict=True))

    async def _exchange(self, socket: ClientConnection, message: dict[str, Any]) -> Any:
        """Send a message and return the answer.

        The time limit is counted from the last answer to any request, because a server may compute its answers one
        after another.

        Raises:
            EvaluationError: no answer within ``timeout_s``, or the answer is invalid or an error of the server.
        """

        async def exchange() -> str | bytes:
            await socket.send(encode_message(message))
            return await socket.recv()

        sent, timeout_s, answer = time.monotonic(), self._address.timeout_s, asyncio.ensure_future(exchange())
        try:
            while not answer.done():
                left = max(sent, self._last_answer) + timeout_s - time.monotonic()
                if left <= 0:
                    raise EvaluationError(
                        f"no answer from the policy server within {timeout_s:g} s",
                        fix="Increase the option timeout_s of the address.",
                    )
                await asyncio.wait({answer}, timeout=left)
            self._last_answer = time.monotonic()
            return decode_server_message(answer.result())
        except CONNECTION_ERRORS as error:
            raise _ConnectionLost(f"lost connection to the policy server: {one_line(error, 300)}") from error
        finally:
            answer.cancel()

    async def _fetch_metadata(self) -> ServerMetadata:
        socket, metadata = await self._open()
        await close_connection(socket)
        return metadata

    async def _connect(self, key: int) -> None:
        socket, metadata = await self._open()
        if (
            self._choose_spec(metadata) != self._choose_spec(self._metadata)
            or metadata.max_batch != self._metadata.max_batch
        ):
            await close_connection(socket)
            what, fix = "the server now serves another policy", "Start the evaluation again with this policy."
            raise EvaluationError(what, where=self._address.url, fix=fix)
        self._connections[key] = _Connection(socket)

    async def _open(self) -> tuple[ClientConnection, ServerMetadata]:
        address = self._address
        return await open_connection(address.url, address.connect_s, pings=self._metadata.answers_pings)

    async def _close(self, *keys: int) -> None:
        found = [self._connections.pop(key) for key in keys if key in self._connections]
        await asyncio.gather(*(close_connection(connection.socket) for connection in found))

    def _choose_spec(self, metadata: ServerMetadata) -> PolicySpec:
        """Return the specification of the policy: from the server, else from the address, else the default.

        Raises:
            EvaluationError: both the server and the address have one, or the policy observes the state of the
                simulation.
        """
        url, given = self._address.url, self._address.spec
        if metadata.spec is None:
            check_observations_can_be_sent(given or PolicySpec(), url)
            return given or PolicySpec()
        if given is not None:
            what = "both the server and the address specify the policy"
            fix = "Remove the options of the address that are fields of PolicySpec, such as cameras."
            raise EvaluationError(what, where=url, fix=fix)
        spec = parse_policy_spec(metadata.spec, url)
        check_observations_can_be_sent(spec, url)
        return spec


def _describe_configs(configs: dict[str, TaskConfig]) -> EvaluationFields:
    return EvaluationFields(configs={name: config.model_dump(mode="json") for name, config in configs.items()})


def _actions_or_error(answer: dict[str, Any]) -> Any:
    """Return an answer of a batch, or an `EvaluationError` if the answer is the error of an env."""
    text = answer.get(ERROR)
    return make_server_error(text) if isinstance(text, str) else answer
