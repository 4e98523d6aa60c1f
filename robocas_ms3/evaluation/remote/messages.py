"""Convert observations and actions to messages and back. Messages are plain maps, which `wire` packs.

The first message of a server is its metadata (`ServerMetadata`). An observation is the map of one env, without an axis
for envs; the answer is ``{"actions": (H, A)}``, or a text with the error, after which the server closes the connection.
A batched request is ``{"batch": [observation, ...]}``; the answer is ``{"batch": [answer, ...]}`` in the same order,
where an answer is ``{"actions": (H, A)}`` or ``{"error": text}``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from robocas_ms3.core.errors import EvaluationError, RobocasError, WireError
from robocas_ms3.core.paths import protocols_dir
from robocas_ms3.core.strict import refusal
from robocas_ms3.core.words import printable
from robocas_ms3.evaluation.actions import CONVENTIONS
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.evaluation.remote.wire import MAX_BYTES
from robocas_ms3.robots.table import DEFAULT

ENV, RESET, START, PROMPT, ACTIONS = "env_id", "reset", "start", "prompt", "actions"
BATCH, ERROR = "batch", "error"
PREFIX = "observation/"
ROBOT = {"qpos": 12, "tcp_in_base": 7, "gripper_width": 1}
_LARGEST = 1e3  # m or rad: physics of what is beyond would be broken, and nobody means it
_MAX_PIXELS = 4096  # a side
_MAX_TEXT = 10_000  # characters
_LONGEST_LINE = 300  # characters
_OTHER_BYTES = 8 * 2**20  # of a request, besides images
_POLICY_SPEC = TypeAdapter(PolicySpec)
WANTS, POLICY = "robocas_wants", "robocas_policy"
MAX_BATCH, ANSWERS_PINGS = "robocas_max_batch", "robocas_answers_pings"
DEFAULT_BATCH, LARGEST_BATCH = 64, 256  # envs
_MAX_DESCRIPTION = 2**20  # characters of JSON
FILE_NAME_PARTS = 3  # of a file's name in messages: folder of the protocol, folder in it, file


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
        raise EvaluationError(
            f"invalid {MAX_BATCH}", where=url, expected="an integer above 0", found=short_line(repr(max_batch))
        )
    if not isinstance(answers_pings, bool):
        raise EvaluationError(
            f"invalid {ANSWERS_PINGS}", where=url, expected="a bool", found=short_line(repr(answers_pings))
        )
    policy = json.dumps(said.get(POLICY), default=str)
    if len(policy) > _MAX_DESCRIPTION:
        expected = f"{_MAX_DESCRIPTION} characters of JSON at most"
        raise EvaluationError("policy description too long", where=url, expected=expected, found=len(policy))
    limit = min(max_batch, LARGEST_BATCH) if max_batch else None
    return ServerMetadata(said.get(WANTS), json.loads(policy), limit, answers_pings)


def read_policy_spec(message: Any, where: object) -> PolicySpec:
    """The way back; what is not said is as `PolicySpec` has it.

    Raises:
        EvaluationError: there is no such thing to want.
    """
    known = [field.name for field in fields(PolicySpec)]
    if not isinstance(message, dict) or not set(message) <= set(known):
        raise EvaluationError(
            "invalid policy specification", where=where, expected=f"some of {known}", found=short_line(message)
        )
    try:
        spec = _POLICY_SPEC.validate_json(json.dumps(message), strict=True)
    except ValidationError as error:
        raise refusal(
            error, _POLICY_SPEC, EvaluationError, where=where, about="invalid policy specification"
        ) from error
    except (TypeError, ValueError) as error:
        raise EvaluationError("invalid policy specification", where=where, found=short_line(error)) from error
    sides = [side for size in spec.cameras.values() for side in size]
    if not all(1 <= side <= _MAX_PIXELS for side in sides) or not 0 < (spec.rate_hz or 1) < math.inf:
        raise EvaluationError("invalid policy specification", where=where, found=short_line(message))
    return spec


def observation_message(
    observations: Observations, row: int, start: EpisodeSpec | None, *, reset: bool
) -> dict[str, Any]:
    """What one env shows.

    Args:
        observations: of several.
        row: which one.
        start: of the episode, where the server is to be told of it; None: it isn't.
        reset: whether the episode begins here.
    """
    message: dict[str, Any] = {ENV: int(observations.envs[row]), RESET: reset, PROMPT: observations.instructions[row]}
    arrays: dict[str, Any] = {name: getattr(observations, name)[row] for name in ROBOT}
    arrays |= {name: images[row] for name, images in observations.images.items()}
    arrays |= {f"{name}_depth": depths[row] for name, depths in observations.depths.items()}
    for name, values in (("embedding", observations.embeddings), ("simulator_state", observations.state)):
        if values is not None:
            arrays[name] = values[row]
    message |= {PREFIX + name: array for name, array in arrays.items()}
    if start is not None:
        message[START] = {name: value for name, value in vars(start).items() if name != "env"}
        message[START] |= {name: name_of(message[START][name]) for name in ("config_file", "layouts_file")}
        if start.robot == DEFAULT:  # a server may be older than that there are others
            del message[START]["robot"]
    return message


def observations_of(message: Mapping[str, Any], env: int, spec: PolicySpec) -> Observations:
    """The way back, a batch of one env.

    Raises:
        WireError: something is not there, or has another shape or type.
    """

    def array(name: str, dtype: Any, *shape: int | None) -> NDArray[Any]:
        found = message.get(PREFIX + name)
        if (
            isinstance(found, np.ndarray)
            and found.dtype.kind == np.dtype(dtype).kind
            and found.ndim == len(shape)
            and all(wanted in (None, length) for wanted, length in zip(shape, found.shape, strict=True))
        ):
            return found.astype(dtype)[None]
        what = f"{found.shape} {found.dtype}" if isinstance(found, np.ndarray) else type(found).__name__
        raise WireError("not in the observation", where=PREFIX + name, expected=f"{shape} {dtype}", found=what)

    prompt = message.get(PROMPT, "")
    if not isinstance(prompt, str):
        raise WireError("an instruction is no text", where=PROMPT, found=type(prompt).__name__)
    check_length(PROMPT, prompt)
    sizes = {name: (height, width) for name, (width, height) in spec.cameras.items()}
    return Observations(
        envs=np.array([env]),
        instructions=[prompt if spec.language != "none" else ""],
        embeddings=array("embedding", "float32", None) if spec.language == "embedding" else None,
        images={name: array(name, "uint8", *size, 3) for name, size in sizes.items()},
        depths={name: array(f"{name}_depth", "int16", *size, 1) for name, size in sizes.items()} if spec.depth else {},
        qpos=array("qpos", "float32", ROBOT["qpos"]),
        tcp_in_base=array("tcp_in_base", "float32", ROBOT["tcp_in_base"]),
        gripper_width=array("gripper_width", "float32", ROBOT["gripper_width"]),
        state=array("simulator_state", "float32", None) if spec.state else None,
    )


def stack_observations(observations: Sequence[Observations]) -> Observations:
    """Return one batch of several, in their order.

    Raises:
        WireError: arrays of the same name differ in shape.
    """
    if len(observations) == 1:
        return observations[0]

    def stack(name: str, arrays: list[Any]) -> Any:
        if arrays[0] is None:
            return None
        if len({array.shape[1:] for array in arrays}) > 1:
            shapes = sorted({str(array.shape[1:]) for array in arrays})
            raise WireError("observations of a batch differ in shape", where=PREFIX + name, found=", ".join(shapes))
        return np.concatenate(arrays)

    def of_all(name: str) -> list[Any]:
        return [getattr(one, name) for one in observations]

    first = observations[0]
    return Observations(
        envs=np.concatenate(of_all("envs")),
        instructions=[text for one in observations for text in one.instructions],
        embeddings=stack("embedding", of_all("embeddings")),
        images={name: stack(name, [one.images[name] for one in observations]) for name in first.images},
        depths={name: stack(f"{name}_depth", [one.depths[name] for one in observations]) for name in first.depths},
        **{name: stack(name, of_all(name)) for name in ROBOT},
        state=stack("simulator_state", of_all("state")),
    )


def name_of(path: str) -> str:
    """Return the name of a protocol's file in messages; its path if a shipped protocol has that name."""
    parts = Path(path).parts
    shipped = protocols_dir()
    if len(parts) < FILE_NAME_PARTS or (
        (shipped / parts[-FILE_NAME_PARTS]).exists() and not Path(path).is_relative_to(shipped)
    ):
        return path
    return "/".join(parts[-FILE_NAME_PARTS:])


def actions_of(reply: Any, convention: str) -> NDArray[np.float32]:
    """(H, A) actions of a reply; a single one may come as (A,).

    Args:
        reply: of a server.
        convention: of the policy's actions.

    Raises:
        WireError: there are none, not of this convention, or not finite.
    """
    size = CONVENTIONS[convention].size
    said = reply.get(ACTIONS) if isinstance(reply, dict) else None
    try:
        found = np.asarray(said)
    except ValueError as error:  # lists of different lengths
        raise WireError("no actions", expected=f"(chunk, {size})", found=short_line(error)) from error
    if found.dtype.kind not in "iuf" or found.ndim not in (1, 2) or found.shape[-1] != size or not found.size:
        what = short_line(reply) if said is None else f"{found.shape} {found.dtype}"
        raise WireError("no actions", expected=f"(chunk, {size}) numbers", found=what)
    if not (np.abs(found.astype(np.float64)) <= _LARGEST).all():  # nor is what is not a number
        raise WireError(
            "an action beyond all measure", expected=f"{_LARGEST:g} at most", found=short_line(found.tolist())
        )
    return found.reshape(-1, size).astype(np.float32)


def batch_of(message: Any, least: int, most: int) -> list[dict[str, Any]]:
    """Return the maps of a batched request, or of the answer to it.

    Args:
        message: with the key ``batch``.
        least: smallest number of maps.
        most: largest number of maps.

    Raises:
        WireError: it is no list of maps, or has another length.
    """
    batch = message.get(BATCH) if isinstance(message, dict) else None
    if not isinstance(batch, list) or not all(isinstance(one, dict) for one in batch):
        raise WireError("invalid batch", where=BATCH, expected="a list of maps", found=type(batch).__name__)
    if not least <= len(batch) <= most:
        raise WireError("invalid batch", where=BATCH, expected=f"{least} to {most} maps", found=len(batch))
    return batch


def one_line(error: BaseException) -> str:
    """Return an error as a line without control characters, for the other end of a connection."""
    said = str(error) if isinstance(error, RobocasError) else f"{type(error).__name__}: {error}"
    return printable(" ".join(said.split())[:_LONGEST_LINE])


def message_bytes(spec: PolicySpec, max_batch: int = 1) -> int:
    """Return the size limit of a request: 8 MiB, and the images of all envs or four times those of one."""
    return min(MAX_BYTES, _OTHER_BYTES + max(4, max_batch) * _image_bytes(spec))


def batch_limit(spec: PolicySpec, envs: int) -> int:
    """Return how many of these envs fit in one request of `MAX_BYTES`, at least 1."""
    return max(1, min(envs, LARGEST_BATCH, (MAX_BYTES - _OTHER_BYTES) // max(1, _image_bytes(spec))))


def _image_bytes(spec: PolicySpec) -> int:
    """Size of the images of one env."""
    pixels = sum(width * height for width, height in spec.cameras.values())
    return pixels * (5 if spec.depth else 3)


def check_length(where: str, text: str) -> None:
    """Check the length of a text of a client.

    Raises:
        WireError: it is too long.
    """
    if len(text) > _MAX_TEXT:
        raise WireError("text too long", where=where, expected=f"{_MAX_TEXT} characters at most", found=len(text))


def short_line(text: object) -> str:
    """Return a value as a line of at most 200 characters, for an error message."""
    return " ".join(str(text).split())[:200]
