"""A policy that asks a server for actions."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError, PolicyFailed, WireError
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.evaluation.remote.address import Address, read_address
from robocas_ms3.evaluation.remote.connection import open_connection, run_in_loop
from robocas_ms3.evaluation.remote.messages import actions_of
from robocas_ms3.evaluation.remote.requests import RequestSender, policy_spec

_LOG = logging.getLogger(__name__)


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
