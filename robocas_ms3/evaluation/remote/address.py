"""Addresses of remote policies: ``ws://host:port``, and after a ``?`` what an openpi server can't say of itself."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qsl, urlsplit, urlunsplit

from robocas_ms3.core.errors import EvaluationError

SCHEMES = ("ws", "wss")
_FLAGS = {"0": False, "1": True}
_FORM = "ws://host:port, of IPv6 ws://[::1]:port"
_COUNT = re.compile(r"[1-9][0-9]{0,8}", re.ASCII)


@dataclass(frozen=True)
class Address:
    """Where a remote policy is, and how to talk to it.

    Attributes:
        url: without options.
        spec: what the policy wants, as its metadata would say; empty: its metadata do.
        rename: other keys of an observation, by name: of a camera, ``qpos``, ``prompt``, ...
        play: of a chunk, how many actions are played before the server is asked again; None: all.
        max_in_flight: number of requests without an answer, for servers without batches; None: one per env.
        timeout_s: clock time in which the server has to answer one of the requests.
        connect_s: clock time in which a connection has to be open, when an episode starts.
    """

    url: str
    spec: dict[str, Any] = field(default_factory=dict)
    rename: dict[str, str] = field(default_factory=dict)
    play: int | None = None
    max_in_flight: int | None = None
    timeout_s: float = 120.0
    connect_s: float = 30.0


def read_address(text: str) -> Address:
    """Read an address with its options.

    ``convention``, ``reference``, ``rate_hz``, ``language``, ``depth=1``, ``state=1`` and
    ``cameras=base_camera:224x224,gripper_camera:224x224`` (width x height) are what a policy wants;
    ``rename=base_camera:observation/image,qpos:observation/state``, ``play=5``, ``max_in_flight=1``, ``timeout_s`` and
    ``connect_s`` are the client's.

    Raises:
        EvaluationError: it is no address, or has an option that is none.
    """
    try:
        parts = urlsplit(text)
        valid = parts.scheme in SCHEMES and bool(parts.hostname) and parts.port != 0
    except ValueError as error:  # of brackets or a port
        raise EvaluationError("no address of a policy", where=text, expected=_FORM, found=error) from error
    if not valid:
        raise EvaluationError("no address of a policy", where=text, expected=_FORM)
    spec: dict[str, Any] = {}
    options: dict[str, Any] = {}
    for name, value in parse_qsl(parts.query, keep_blank_values=True):
        if name in ("convention", "reference", "language"):
            spec[name] = value
        elif name == "rate_hz":
            spec[name] = _number(name, value)
        elif name in ("depth", "state") and value in _FLAGS:
            spec[name] = _FLAGS[value]
        elif name == "cameras":
            spec[name] = {camera: _size(name, size) for camera, size in _pairs(name, value).items()}
        elif name == "rename":
            options[name] = _pairs(name, value)
        elif name in ("play", "max_in_flight") and _COUNT.fullmatch(value):
            options[name] = int(value)
        elif name in ("timeout_s", "connect_s"):
            options[name] = _number(name, value)
        else:
            raise EvaluationError("no such option of an address", where=f"{name}={value}", fix=_HELP)
    return Address(urlunsplit((parts.scheme, parts.netloc, parts.path, "", "")), spec, **options)


def strip_brackets(host: str) -> str:
    """Return a host without the brackets that an IPv6 address has in a URL."""
    return host[1:-1] if host.startswith("[") and host.endswith("]") else host


def netloc(host: str, port: int) -> str:
    """Return host and port as a URL has them: an IPv6 address in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


_HELP = (
    "There are convention, reference, language, rate_hz, depth=1, state=1, cameras=NAME:WxH,..., "
    "rename=NAME:KEY,..., play=N, max_in_flight=N, timeout_s and connect_s."
)


def _pairs(name: str, text: str) -> dict[str, str]:
    pairs = [pair.partition(":") for pair in text.split(",")]
    if not all(key and value for key, _, value in pairs):
        raise EvaluationError("no list of pairs", where=name, expected="A:B,C:D", found=text)
    return {key: value for key, _, value in pairs}


def _size(name: str, text: str) -> list[int]:
    sides = text.split("x")
    if len(sides) != 2 or not all(map(_COUNT.fullmatch, sides)):
        raise EvaluationError("no size of pictures", where=name, expected="WIDTHxHEIGHT", found=text)
    return [int(side) for side in sides]


def _number(name: str, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise EvaluationError("no number above 0", where=name, found=text)
    return number
