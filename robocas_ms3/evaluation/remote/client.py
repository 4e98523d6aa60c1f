"""A policy that asks a server for actions, and the requests that it sends."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError, PolicyFailed, WireError
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.evaluation.remote.address import Address, read_address
from robocas_ms3.evaluation.remote.connection import (
    AnswerTimer,
    Connection,
    ConnectionFailed,
    error_line,
    open_connection,
    run_in_loop,
)
from robocas_ms3.evaluation.remote.messages import (
    BATCH,
    ERROR,
    PREFIX,
    ServerMetadata,
    actions_of,
    batch_of,
    observation_message,
    read_policy_spec,
)
from robocas_ms3.evaluation.remote.wire import pack

_LOG = logging.getLogger(__name__)
_SHARED = -1  # key of the connection for batched requests; other keys are numbers of envs


class RemotePolicy:
    """Ask a server for the actions of all envs at the same time.

    A server that announces ``robocas_max_batch`` gets the observations of all envs in one request. Any other server
    gets one request per env, each over a connection of its own, and all of them are in flight together. Answers are
    read in the order of the envs, so the order in which they arrive changes nothing.

    A forked process cannot use the policy of its parent; it makes its own.

    A lost connection is opened again when the next episode starts: a server that restarted does not know the present
    one.

    Args:
        address: ``ws://host:port``, with options (`read_address`).

    Raises:
        EvaluationError: no such server, or what its policy wants is missing or invalid.
    """

    def __init__(self, address: str) -> None:
        self._address: Address = read_address(address)
        connection = run_in_loop(open_connection(self._address.url, self._address.connect_s))
        try:
            spec = policy_spec(connection.metadata, self._address)
        except EvaluationError:
            run_in_loop(connection.close())
            raise
        # With `play` the server is asked before a chunk ends, so each observation needs images.
        self.spec: PolicySpec = replace(spec, look_every=1) if self._address.play else spec
        self._description = connection.metadata.policy
        self._sender = RequestSender(self._address, connection)
        self._starts: dict[int, EpisodeSpec] = {}  # of episodes that the server does not know yet
        self._chunk_length: int | None = None

    def describe(self) -> dict[str, Any]:
        """Return what a result says of the policy: the server's description."""
        rename = {"rename": self._address.rename} if self._address.rename else {}
        return {"server": self._description, "play": self._address.play, **rename}

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Start episodes; the server learns of them with their first observation."""
        self._starts |= {start.env: start for start in starts}

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return (E, H, A) chunks.

        Raises:
            PolicyFailed: some envs got no actions; the error has the chunks of the others.
        """
        envs: list[int] = observations.envs.tolist()
        starts = {env: self._starts.pop(env) for env in envs if env in self._starts}
        chunks: dict[int, NDArray[np.float32]] = {}
        reasons: dict[int, str] = {}
        for row, answer in enumerate(self._sender.send(observations, starts)):
            try:
                chunks[row] = self._chunk(answer)
            except EvaluationError as error:
                reasons[envs[row]] = str(error)
                _LOG.warning("env %d: %s", envs[row], error)
                self._sender.forget(envs[row])
        if not reasons:
            return np.stack(list(chunks.values()))
        if not chunks:
            raise PolicyFailed(reasons)
        actions = np.zeros((len(envs), *next(iter(chunks.values())).shape), np.float32)
        for row, chunk in chunks.items():
            actions[row] = chunk
        raise PolicyFailed(reasons, actions)

    def close(self) -> None:
        """Close all connections."""
        self._sender.close()

    def _chunk(self, answer: Any) -> NDArray[np.float32]:
        """Return the (H, A) actions of an answer; raise where it is an error."""
        if isinstance(answer, EvaluationError):
            raise answer
        chunk = actions_of(answer, self.spec.convention)[: self._address.play]
        self._chunk_length = self._chunk_length or len(chunk)
        if len(chunk) != self._chunk_length:
            raise WireError("chunks differ in length", expected=self._chunk_length, found=len(chunk))
        return chunk


@dataclass
class Round:
    """One observation per env, and the answers.

    Attributes:
        observations: of E envs.
        starts: the episodes that start with this observation, by env.
        answers: by row: the map with the actions, or the error.
    """

    observations: Observations
    starts: Mapping[int, EpisodeSpec]
    answers: dict[int, Any] = field(default_factory=dict)

    def env(self, row: int) -> int:
        """Return the env of a row."""
        return int(self.observations.envs[row])

    def fail(self, rows: Sequence[int], error: EvaluationError) -> None:
        """Note that there is no answer for these rows."""
        self.answers |= dict.fromkeys(rows, error)


@dataclass
class _Part:
    """Observations that are sent in one message.

    Attributes:
        key: of the connection.
        rows: of the observations.
    """

    key: int
    rows: list[int]


class RequestSender:
    """Connections to a server, and the requests over them.

    A server that takes batches has one connection, any other server one per env.

    Args:
        address: of the server.
        connection: the first one, on which nothing was sent.
    """

    def __init__(self, address: Address, connection: Connection) -> None:
        self._address, self._metadata = address, connection.metadata
        self._terms = _terms(connection.metadata, address)
        self._unused: Connection | None = connection
        self._connections: dict[int, Connection] = {}
        self._timer = AnswerTimer(address.timeout_s)

    def send(self, observations: Observations, starts: Mapping[int, EpisodeSpec]) -> list[Any]:
        """Send observations and wait for all answers.

        Args:
            observations: of E envs.
            starts: the episodes that start with this observation, by env.

        Returns:
            E answers: a map with the actions, or the error.
        """
        asked = Round(observations, starts)
        run_in_loop(self._send(asked))
        return [asked.answers[row] for row in range(len(observations.envs))]

    def forget(self, env: int) -> None:
        """End an episode whose answer was invalid; without batches its connection is closed."""
        if env in self._connections:
            run_in_loop(self._close(env))
        elif _SHARED in self._connections:
            self._connections[_SHARED].envs.discard(env)

    def close(self) -> None:
        """Close all connections."""
        connections = [*self._connections.values(), *([self._unused] if self._unused else [])]
        self._connections, self._unused = {}, None
        run_in_loop(_close_all(connections))

    async def _send(self, asked: Round) -> None:
        rows = range(len(asked.observations.envs))
        size = self._metadata.max_batch
        if size is None:
            parts = [_Part(asked.env(row), [row]) for row in rows]
        else:
            parts = [_Part(_SHARED, [*rows[first : first + size]]) for first in rows[::size]]
        for _ in range(2):  # a server may have restarted since the last episode
            # A plain openpi server accepts no connection during inference, so all are opened before the first request.
            await self._connect_all(parts, asked)
            await self._request_all(parts, asked)

    async def _connect_all(self, parts: Sequence[_Part], asked: Round) -> None:
        """Open missing connections for episodes that start; episodes whose connection was lost have failed."""
        for part in parts:
            connection = self._connections.get(part.key)
            known = connection.envs if connection else set()
            lost = [row for row in part.rows if asked.env(row) not in {*known, *asked.starts}]
            asked.fail(lost, ConnectionFailed("the connection is lost", gone=True))
            part.rows = [row for row in part.rows if row not in lost]
        missing = {part.key for part in parts if part.rows} - self._connections.keys()
        failures = dict(zip(missing, await asyncio.gather(*map(self._connect, missing)), strict=True))
        for part in parts:
            if failure := failures.get(part.key):
                asked.fail(part.rows, failure)
                part.rows = []

    async def _request_all(self, parts: Sequence[_Part], asked: Round) -> None:
        """Send requests and wait for all answers; rows that remain in the parts are to be asked again."""
        in_flight = 1 if self._metadata.max_batch else self._address.max_in_flight or len(parts)
        slots = asyncio.Semaphore(in_flight)

        async def request(part: _Part) -> None:
            async with slots:
                if part.rows:
                    await self._request(part, asked)

        await asyncio.gather(*map(request, parts))

    async def _request(self, part: _Part, asked: Round) -> None:
        rows, part.rows = part.rows, []
        messages = [self._message(row, asked) for row in rows]
        try:
            connection = self._connections.get(part.key)
            if connection is None:
                raise ConnectionFailed("the connection is lost", gone=True)
            if self._metadata.max_batch is None:
                answers = [await self._timer.limit(connection.request(pack(messages[0])))]
            else:
                answer = await self._timer.limit(connection.request(pack({BATCH: messages})))
                answers = [_without_error(one) for one in batch_of(answer, len(rows), len(rows))]
        except EvaluationError as error:
            await self._close(part.key)
            asked.fail(rows, error)
            if isinstance(error, ConnectionFailed) and error.gone:
                part.rows = [row for row in rows if asked.env(row) in asked.starts]
        else:
            asked.answers |= dict(zip(rows, answers, strict=True))
            connection.envs |= {asked.env(row) for row in rows}

    def _message(self, row: int, asked: Round) -> dict[str, Any]:
        start = asked.starts.get(asked.env(row))
        shown = start if self._metadata.spec is not None else None  # a plain openpi server does not expect the key
        message = observation_message(asked.observations, row, shown, reset=start is not None)
        rename = self._address.rename
        return {rename.get(key.removeprefix(PREFIX), key): value for key, value in message.items()}

    async def _connect(self, key: int) -> EvaluationError | None:
        """Open a connection; return why there is none."""
        try:
            self._connections[key] = await self._open()
        except EvaluationError as error:
            return error
        return None

    async def _open(self) -> Connection:
        if self._unused is not None:
            connection, self._unused = self._unused, None
            return connection
        connection = await open_connection(self._address.url, self._address.connect_s)
        try:
            if self._terms != _terms(connection.metadata, self._address):
                raise ConnectionFailed("another policy is served now: the server announces something else")
        except EvaluationError:
            await connection.close()
            raise
        return connection

    async def _close(self, key: int) -> None:
        if connection := self._connections.pop(key, None):
            await connection.close()


def policy_spec(metadata: ServerMetadata, address: Address) -> PolicySpec:
    """Return what a policy declares, as its server announces it or the address says.

    Raises:
        EvaluationError: it is invalid, or both say it.
    """
    if metadata.spec is not None and address.spec:
        fix = "Leave these out of the address."
        found = sorted(address.spec)
        raise EvaluationError(
            "the server announces its policy specification itself", where=address.url, found=found, fix=fix
        )
    return read_policy_spec(address.spec if metadata.spec is None else metadata.spec, address.url)


def _terms(metadata: ServerMetadata, address: Address) -> tuple[PolicySpec, int | None]:
    """What has to stay as it is over all connections."""
    return policy_spec(metadata, address), metadata.max_batch


def _without_error(answer: dict[str, Any]) -> Any:
    """Return an answer of a batch, or the error that it holds."""
    text = answer.get(ERROR)
    return ConnectionFailed(f"the server failed: {error_line(text)}") if isinstance(text, str) else answer


async def _close_all(connections: Sequence[Connection]) -> None:
    await asyncio.gather(*(connection.close() for connection in connections))
