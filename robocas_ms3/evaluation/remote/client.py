"""A policy that asks a server what to do."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.errors import EvaluationError, PolicyFailed, WireError
from robocas_ms3.evaluation.policy import Observations, Start, Wants
from robocas_ms3.evaluation.remote.address import Address, read_address
from robocas_ms3.evaluation.remote.link import Link, LinkBroken
from robocas_ms3.evaluation.remote.messages import (
    POLICY,
    PREFIX,
    WANTS,
    actions_of,
    observation_message,
    wants_of,
)
from robocas_ms3.evaluation.remote.wire import pack

_LOG = logging.getLogger(__name__)
_MAX_DESCRIPTION = 2**20


class RemotePolicy:
    """Asks a server, env by env, over a connection each, so that what goes wrong in one is over with its episode.

    A server that is not there any more is looked for again when the next episode begins: one that comes back in the
    middle of an episode knows nothing of it.

    Args:
        address: ``ws://host:port``, with options (`read_address`).

    Raises:
        EvaluationError: no such server, or it is not clear what it wants.
    """

    def __init__(self, address: str) -> None:
        self._address: Address = read_address(address)
        link = Link(self._address.url, self._address.connect_s)
        metadata = link.metadata if isinstance(link.metadata, dict) else {}
        self._said: Any = metadata.get(WANTS)
        if self._said is not None and self._address.wants:
            link.close()
            raise EvaluationError(
                "the server says itself what it wants",
                where=self._address.url,
                found=sorted(self._address.wants),
                fix="Leave these out of the address.",
            )
        wants = wants_of(self._address.wants if self._said is None else self._said, self._address.url)
        self.wants: Wants = replace(wants, look_every=1) if self._address.play else wants  # it is asked more often
        self._about = _description(metadata.get(POLICY), self._address.url)
        self._spare: list[Link] = [link]
        self._links: dict[int, Link] = {}
        self._starts: dict[int, Start] = {}  # of episodes that no server was told of yet
        self._horizon: int | None = None

    def describe(self) -> dict[str, Any]:
        """What a result says of it: what the server says of its policy."""
        rename = {"rename": self._address.rename} if self._address.rename else {}
        return {"server": self._about, "play": self._address.play, **rename}

    def reset(self, starts: list[Start]) -> None:
        """Begin episodes; the server is told with the first observation."""
        self._starts |= {start.env: start for start in starts}

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """(E, H, A) chunks.

        Raises:
            PolicyFailed: with chunks of the envs for which there are some.
        """
        chunks: dict[int, NDArray[np.float32]] = {}
        reasons: dict[int, str] = {}
        for row, env in enumerate(observations.envs.tolist()):
            try:
                chunks[row] = self._chunk(env, observations, row)
            except (LinkBroken, WireError) as error:
                reasons[env] = str(error)
                _LOG.warning("env %d: %s", env, error)
                self._hang_up(env)
        if not reasons:
            return np.stack(list(chunks.values()))
        if not chunks:
            raise PolicyFailed(reasons)
        actions = np.zeros((len(observations.envs), *next(iter(chunks.values())).shape), np.float32)
        for row, chunk in chunks.items():
            actions[row] = chunk
        raise PolicyFailed(reasons, actions)

    def close(self) -> None:
        """Hang up all connections."""
        for link in [*self._spare, *self._links.values()]:
            link.close(wait_s=1)
        self._spare.clear()
        self._links.clear()

    def _chunk(self, env: int, observations: Observations, row: int) -> NDArray[np.float32]:
        start = self._starts.pop(env, None)
        told = start if self._said is not None else None  # a plain openpi server would not know what to do with it
        message = observation_message(observations, row, told, reset=start is not None)
        reply = self._ask(env, pack(self._renamed(message)), begins=start is not None)
        chunk = actions_of(reply, self.wants.convention)[: self._address.play]
        self._horizon = self._horizon or len(chunk)
        if len(chunk) != self._horizon:
            raise WireError("chunks differ in length", expected=self._horizon, found=len(chunk))
        return chunk

    def _ask(self, env: int, data: bytes, *, begins: bool) -> Any:
        if begins:
            used = self._links.get(env) or (self._spare.pop() if self._spare else None)
            if used is not None:
                self._links[env] = used
                try:
                    return used.ask(data, self._address.timeout_s)
                except LinkBroken as error:
                    if not error.gone:
                        raise
                    self._hang_up(env)  # the server went away since the last episode
            self._links[env] = self._connect()
        if env not in self._links:
            raise LinkBroken("the connection is lost", gone=True)
        return self._links[env].ask(data, self._address.timeout_s)

    def _connect(self) -> Link:
        link = Link(self._address.url, self._address.connect_s)
        said = link.metadata.get(WANTS) if isinstance(link.metadata, dict) else None
        if said != self._said:
            link.close()
            raise LinkBroken("there is another policy now: it wants something else")
        return link

    def _hang_up(self, env: int) -> None:
        if env in self._links:
            self._links.pop(env).close()

    def _renamed(self, message: dict[str, Any]) -> dict[str, Any]:
        rename = self._address.rename
        return {rename.get(key.removeprefix(PREFIX), key): value for key, value in message.items()}


def _description(said: Any, url: str) -> Any:
    """Return what a server says of its policy as JSON values.

    Raises:
        EvaluationError: it is too long for a result.
    """
    text = json.dumps(said, default=str)
    if len(text) > _MAX_DESCRIPTION:
        expected = f"{_MAX_DESCRIPTION} characters of JSON at most"
        raise EvaluationError("policy description too long", where=url, expected=expected, found=len(text))
    return json.loads(text)
