"""What client and server say: wants, observations of one env, actions. Plain maps, as `wire` packs them.

A server begins with its metadata, then each observation is answered by ``{"actions": (H, A)}``, or by a line that says
what went wrong, after which it hangs up. Arrays of an observation have no axis for envs.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from robocas_ms3.errors import EvaluationError, RobocasError, WireError
from robocas_ms3.evaluation.actions import CONVENTIONS
from robocas_ms3.evaluation.policy import Observations, Start, Wants
from robocas_ms3.evaluation.remote.served import ServedFiles, name_of
from robocas_ms3.evaluation.remote.wire import MAX_BYTES
from robocas_ms3.robots.table import DEFAULT
from robocas_ms3.strict import refusal
from robocas_ms3.words import printable

WANTS, POLICY = "robocas_wants", "robocas_policy"  # keys of the metadata
ENV, RESET, START, PROMPT, ACTIONS = "env_id", "reset", "start", "prompt", "actions"
PREFIX = "observation/"
ROBOT = {"qpos": 12, "tcp_in_base": 7, "gripper_width": 1}
_LARGEST = 1e3  # m or rad: physics of what is beyond would be broken, and nobody means it
_MAX_PIXELS = 4096  # a side
_MAX_TEXT = 10_000  # characters
_LARGEST_NUMBER = 2**32 - 1  # of episodes and seeds
_LONGEST_LINE = 300  # characters
_WANTS = TypeAdapter(Wants)


def wants_of(message: Any, where: object) -> Wants:
    """The way back; what is not said is as `Wants` has it.

    Raises:
        EvaluationError: there is no such thing to want.
    """
    known = [field.name for field in fields(Wants)]
    if not isinstance(message, dict) or not set(message) <= set(known):
        raise EvaluationError("no wants of a policy", where=where, expected=f"some of {known}", found=_line(message))
    try:
        wants = _WANTS.validate_json(json.dumps(message), strict=True)
    except ValidationError as error:
        raise refusal(error, _WANTS, EvaluationError, where=where, about="no wants of a policy") from error
    except (TypeError, ValueError) as error:
        raise EvaluationError("no wants of a policy", where=where, found=_line(error)) from error
    sides = [side for size in wants.cameras.values() for side in size]
    if not all(1 <= side <= _MAX_PIXELS for side in sides) or not 0 < (wants.rate_hz or 1) < math.inf:
        raise EvaluationError("no wants of a policy", where=where, found=_line(message))
    return wants


def observation_message(observations: Observations, row: int, start: Start | None, *, reset: bool) -> dict[str, Any]:
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


def observations_of(message: Mapping[str, Any], env: int, wants: Wants) -> Observations:
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
    _check_length(PROMPT, prompt)
    sizes = {name: (height, width) for name, (width, height) in wants.cameras.items()}
    return Observations(
        envs=np.array([env]),
        instructions=[prompt if wants.language != "none" else ""],
        embeddings=array("embedding", "float32", None) if wants.language == "embedding" else None,
        images={name: array(name, "uint8", *size, 3) for name, size in sizes.items()},
        depths={name: array(f"{name}_depth", "int16", *size, 1) for name, size in sizes.items()} if wants.depth else {},
        qpos=array("qpos", "float32", ROBOT["qpos"]),
        tcp_in_base=array("tcp_in_base", "float32", ROBOT["tcp_in_base"]),
        gripper_width=array("gripper_width", "float32", ROBOT["gripper_width"]),
        state=array("simulator_state", "float32", None) if wants.state else None,
    )


def start_of(message: Mapping[str, Any], env: int, files: ServedFiles) -> Start:
    """Return the episode that starts; of a client that does not say more, the instruction alone.

    Args:
        message: of the client.
        env: of the policy.
        files: that the client may choose.

    Raises:
        WireError: it is no start of an episode.
    """
    blank = Start(env, 0, "", "", "", "", 0, message.get(PROMPT, ""))
    said = message.get(START, {})
    if not isinstance(said, dict) or not said.keys() <= vars(blank).keys() - {"env"}:
        raise WireError("no start of an episode", where=START, found=_line(said))
    for name, value in said.items():
        if type(value) is not type(getattr(blank, name)):
            raise WireError("no start of an episode", where=f"{START}.{name}", found=_line(repr(value)))
        if isinstance(value, int) and not 0 <= value <= _LARGEST_NUMBER:
            expected = f"0 to {_LARGEST_NUMBER}"
            raise WireError("number out of range", where=f"{START}.{name}", expected=expected, found=value)
        if isinstance(value, str):
            _check_length(f"{START}.{name}", value)
    return files.resolved(Start(**{**vars(blank), **said}))


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
        raise WireError("no actions", expected=f"(chunk, {size})", found=_line(error)) from error
    if found.dtype.kind not in "iuf" or found.ndim not in (1, 2) or found.shape[-1] != size or not found.size:
        what = _line(reply) if said is None else f"{found.shape} {found.dtype}"
        raise WireError("no actions", expected=f"(chunk, {size}) numbers", found=what)
    if not (np.abs(found.astype(np.float64)) <= _LARGEST).all():  # nor is what is not a number
        raise WireError("an action beyond all measure", expected=f"{_LARGEST:g} at most", found=_line(found.tolist()))
    return found.reshape(-1, size).astype(np.float32)


def one_line(error: BaseException) -> str:
    """Return an error as a line without control characters, for the other end of a connection."""
    said = str(error) if isinstance(error, RobocasError) else f"{type(error).__name__}: {error}"
    return printable(" ".join(said.split())[:_LONGEST_LINE])


def message_bytes(wants: Wants) -> int:
    """Return a size that no observation of a policy reaches: four times its pictures, and 8 MiB."""
    pixels = sum(width * height for width, height in wants.cameras.values())
    return min(MAX_BYTES, 4 * pixels * (5 if wants.depth else 3) + 8 * 2**20)


def _check_length(where: str, text: str) -> None:
    if len(text) > _MAX_TEXT:
        raise WireError("text too long", where=where, expected=f"{_MAX_TEXT} characters at most", found=len(text))


def _line(text: object) -> str:
    return " ".join(str(text).split())[:200]
