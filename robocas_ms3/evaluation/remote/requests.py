"""Send the observations of all envs to a server, and collect the answers."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.evaluation.remote.address import Address
from robocas_ms3.evaluation.remote.connection import (
    AnswerTimer,
    Connection,
    ConnectionFailed,
    error_line,
    open_connection,
    run_in_loop,
)
from robocas_ms3.evaluation.remote.messages import BATCH, ERROR, PREFIX, batch_of, observation_message, read_policy_spec
from robocas_ms3.evaluation.remote.metadata import ServerMetadata
from robocas_ms3.evaluation.remote.wire import pack

_SHARED = -1  # key of the connection for batched requests; other keys are numbers of envs


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
