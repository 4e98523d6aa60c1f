"""Addresses of remote policies: ``ws://host:port``, with options after a ``?``."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Annotated, Any
from urllib.parse import parse_qsl, urlsplit, urlunsplit

from pydantic import ConfigDict, Field, PositiveInt, TypeAdapter, ValidationError

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.strict import refusal
from robocas_ms3.evaluation.policy import PolicySpec

_Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Text = Annotated[str, Field(min_length=1)]


@dataclass(frozen=True)
class Address:
    """Where a remote policy is, and how to talk to it.

    Attributes:
        url: without options.
        spec: the policy's specification, for servers that do not announce it; None: not given.
        rename: other keys of an observation, by name: of a camera, ``qpos``, ``prompt``, ...
        play: number of actions of a chunk that are executed before the server is asked again; None: all.
        max_in_flight: number of requests without an answer, for servers without batches; None: one per env.
        timeout_s: clock time in which the server has to answer one of the requests.
        connect_s: clock time in which a connection has to be open, when an episode starts.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    url: str
    spec: PolicySpec | None = None
    rename: dict[_Text, _Text] = field(default_factory=dict)
    play: PositiveInt | None = None
    max_in_flight: PositiveInt | None = None
    timeout_s: _Seconds = 120.0
    connect_s: _Seconds = 30.0


_FORM = TypeAdapter(Address)
_SPEC = {field.name for field in fields(PolicySpec)}


def read_address(text: str) -> Address:
    """Read an address. Its options are the fields of `PolicySpec` and `Address`.

    ``cameras=base_camera:224x224,gripper_camera:224x224`` (width x height) and
    ``rename=base_camera:observation/image,qpos:observation/state`` are lists of pairs.

    Raises:
        EvaluationError: the address or an option is invalid.
    """
    try:
        parts = urlsplit(text)
        valid = parts.scheme in ("ws", "wss") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # of brackets or a port
        valid = False
    if not valid:
        raise EvaluationError("invalid address of a policy", where=text, expected="ws://host:port or ws://[::1]:port")
    options: dict[str, Any] = dict(parse_qsl(parts.query, keep_blank_values=True))
    for name in options.keys() & {"cameras", "rename"}:
        options[name] = {key: value for key, _, value in (pair.partition(":") for pair in options[name].split(","))}
    if "cameras" in options:
        options["cameras"] = {camera: size.split("x") for camera, size in options["cameras"].items()}
    values = {name: options.pop(name) for name in options.keys() & _SPEC}
    url = urlunsplit((parts.scheme, parts.netloc, parts.path, "", ""))
    try:
        return _FORM.validate_python({**options, "url": url, "spec": values or None})
    except ValidationError as problem:
        raise refusal(problem, _FORM, EvaluationError, where=text, about="invalid address of a policy") from problem


def strip_brackets(host: str) -> str:
    """Return a host without the brackets that an IPv6 address has in a URL."""
    return host[1:-1] if host.startswith("[") and host.endswith("]") else host


def netloc(host: str, port: int) -> str:
    """Return host and port as a URL has them: an IPv6 address in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
