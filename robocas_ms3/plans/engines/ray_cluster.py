"""The cluster of Ray that units are done on: options, and how it is found or started."""

from __future__ import annotations

import logging
import math
import os
import socket
from collections.abc import Mapping
from importlib import import_module
from typing import Annotated, Any

from pydantic import Field

from robocas_ms3.core.errors import MissingExtraError, PlanError
from robocas_ms3.core.strict import StrictModel, parse
from robocas_ms3.plans.engines import refuse_options

_ANSWERING = 10.0  # s
_log = logging.getLogger(__name__)


class RayOptions(StrictModel):
    """What ``--executor-option`` may say."""

    address: str | None = Field(
        default=None, description="of the cluster; default: RAY_ADDRESS, or else one is started on this machine"
    )
    num_cpus: Annotated[float, Field(gt=0)] = Field(default=1.0, description="an actor takes")
    num_gpus: Annotated[float, Field(ge=0)] = Field(default=0.0, description="an actor takes")
    gather: bool = Field(default=False, description="whether nodes send what they make: they don't see the folder")


def read_options(options: Mapping[str, str]) -> RayOptions:
    """Read the words of ``--executor-option``.

    Raises:
        PlanError: there is no such option, or it has no such value.
    """
    refuse_options("ray", options, tuple(RayOptions.model_fields))
    values = {name: value if name == "address" else _value(value) for name, value in options.items()}
    return parse(RayOptions, values, PlanError, where="--executor-option", about="no option of Ray")


def _value(text: str) -> Any:
    if text in {"yes", "true", "no", "false"}:
        return text in {"yes", "true"}
    try:
        return float(text)
    except ValueError:
        return text


def require_ray() -> Any:
    """The module ``ray``.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        return import_module("ray")
    except ImportError as error:
        fix = 'In the clone: pip install -e ".[ray]"'
        raise MissingExtraError("plans on Ray need ray, which is not installed", fix=fix) from error


def connect(options: RayOptions, jobs: int) -> bool:
    """Connect to the cluster.

    Args:
        options: how.
        jobs: actors that there will be.

    Returns:
        Whether to disconnect in the end: this process was not connected before.

    Raises:
        PlanError: there is no such cluster, or one here would have no room for an actor.
    """
    ray = require_ray()
    address = options.address or os.environ.get("RAY_ADDRESS") or "local"
    before = ray.is_initialized()
    if not before:
        if address.startswith("ray://"):
            fix = "Run this on a node of the cluster, as `ray job submit` does, with address=auto."
            raise PlanError("Ray's client can't do this", where="--executor-option address", found=address, fix=fix)
        _check_answers(address)
        about: dict[str, Any] = {}
        if address == "local":
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            about = {"num_cpus": math.ceil(jobs * options.num_cpus), "include_dashboard": False}
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **about)
        except (ray.exceptions.RayError, OSError, RuntimeError, ValueError) as error:
            found, fix = " ".join(f"{error}".split())[:300], "See `ray status` there."
            raise PlanError("no cluster of Ray answers", where=address, found=found, fix=fix) from error
    try:
        _check_room(ray, options, may_grow=before or address != "local")
    except PlanError:
        ray.shutdown()
        raise
    return not before


def _check_answers(address: str) -> None:
    """See that something listens: ray would try for minutes, and then end the process."""
    host, colon, port = address.rpartition(":")
    if not (colon and port.isdecimal()):
        return  # such as auto
    try:
        socket.create_connection((host, int(port)), _ANSWERING).close()
    except (OSError, OverflowError) as error:
        fix = "See `ray status` there."
        raise PlanError("no cluster of Ray answers", where=address, found=error, fix=fix) from error


def _check_room(ray: Any, options: RayOptions, may_grow: bool) -> None:
    wanted = {"CPU": options.num_cpus, "GPU": options.num_gpus}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if any(all(node.get(kind, 0) >= count for kind, count in wanted.items()) for node in nodes):
        return
    expected = ", ".join(f"{count:g} {kind}" for kind, count in wanted.items())
    error = PlanError(
        "no node of the cluster of Ray has room for an actor", where="--executor-option", expected=expected
    )
    if not may_grow:
        raise error
    _log.warning("%s; waiting for one", error)
