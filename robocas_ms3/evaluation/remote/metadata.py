"""What a server announces in the first message of a connection."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from robocas_ms3.core.errors import EvaluationError

WANTS, POLICY = "robocas_wants", "robocas_policy"
MAX_BATCH, ANSWERS_PINGS = "robocas_max_batch", "robocas_answers_pings"
DEFAULT_BATCH, LARGEST_BATCH = 64, 256  # envs
_MAX_DESCRIPTION = 2**20  # characters of JSON


@dataclass(frozen=True)
class ServerMetadata:
    """The metadata of a server. A plain openpi server announces none of them.

    Attributes:
        spec: what the policy declares, as a message has it; None: not announced.
        policy: description of the policy, JSON values.
        max_batch: number of envs that a batched request may have; None: no batched requests.
        answers_pings: whether the server answers websocket pings during inference.
    """

    spec: Any = None
    policy: Any = None
    max_batch: int | None = None
    answers_pings: bool = False

    def message(self) -> dict[str, Any]:
        """Return the message; `read_metadata` reads it."""
        return {
            WANTS: self.spec,
            POLICY: self.policy,
            MAX_BATCH: self.max_batch,
            ANSWERS_PINGS: self.answers_pings,
        }


def read_metadata(message: Any, url: str) -> ServerMetadata:
    """Read a server's metadata; keys of other packages are ignored.

    Raises:
        EvaluationError: a value is out of range.
    """
    said = message if isinstance(message, dict) else {}
    max_batch, answers_pings = said.get(MAX_BATCH), said.get(ANSWERS_PINGS, False)
    if max_batch is not None and not (type(max_batch) is int and max_batch >= 1):
        raise EvaluationError(f"invalid {MAX_BATCH}", where=url, expected="an integer above 0", found=_short(max_batch))
    if not isinstance(answers_pings, bool):
        raise EvaluationError(f"invalid {ANSWERS_PINGS}", where=url, expected="a bool", found=_short(answers_pings))
    policy = json.dumps(said.get(POLICY), default=str)
    if len(policy) > _MAX_DESCRIPTION:
        expected = f"{_MAX_DESCRIPTION} characters of JSON at most"
        raise EvaluationError("policy description too long", where=url, expected=expected, found=len(policy))
    limit = min(max_batch, LARGEST_BATCH) if max_batch else None
    return ServerMetadata(said.get(WANTS), json.loads(policy), limit, answers_pings)


def _short(value: Any) -> str:
    return " ".join(repr(value).split())[:200]
