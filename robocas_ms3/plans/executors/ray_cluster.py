"""The cluster of Ray: options, and a connection to it."""

from __future__ import annotations

import logging
import math
import os
import socket
from importlib import import_module
from typing import Annotated, Any

from pydantic import Field

from robocas_ms3.core.errors import MissingExtraError, PlanError
from robocas_ms3.core.strict import StrictModel

_TIMEOUT = 10.0  # s
_log = logging.getLogger(__name__)


class RayOptions(StrictModel):
    """Values of ``--executor-option``."""

    address: str | None = Field(
        default=None, description="of the cluster; default: RAY_ADDRESS, or a cluster that is started on this machine"
    )
    num_cpus: Annotated[float, Field(gt=0)] = Field(default=1.0, description="of a task")
    num_gpus: Annotated[float, Field(ge=0)] = Field(default=0.0, description="of a task")
    units_per_job: Annotated[int, Field(ge=1)] = Field(default=4, description="that a task does one after the other")
    gather: bool = Field(default=False, description="nodes do not see the folder, and send their files")


def require_ray() -> Any:
    """Return the module ``ray``.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        return import_module("ray")
    except ImportError as error:
        fix = 'In the clone: pip install -e ".[ray]"'
        raise MissingExtraError("plans on Ray need ray, which is not installed", fix=fix) from error


def connect(options: RayOptions, jobs: int) -> bool:
    """Connect to the cluster, or start one on this machine for some jobs.

    Returns:
        Whether to disconnect in the end: this process was not connected before.

    Raises:
        PlanError: there is no such cluster, or a cluster on this machine would have no room for a task.
    """
    ray = require_ray()
    address = options.address or os.environ.get("RAY_ADDRESS") or "local"
    connected = ray.is_initialized()
    if not connected:
        if address.startswith("ray://"):
            fix = "Run this on a node of the cluster, as `ray job submit` does, with address=auto."
            raise PlanError("Ray's client is not supported", where="--executor-option address", found=address, fix=fix)
        _check_answers(address)
        chosen: dict[str, Any] = {}
        if address == "local":
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            chosen = {"num_cpus": math.ceil(jobs * options.num_cpus), "include_dashboard": False}
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **chosen)
        except (ray.exceptions.RayError, OSError, RuntimeError, ValueError) as error:
            found = " ".join(f"{error}".split())[:300]
            raise _no_answer(address, found) from error
    try:
        _check_room(ray, options, may_grow=connected or address != "local")
    except PlanError:
        ray.shutdown()
        raise
    return not connected


def _check_answers(address: str) -> None:
    """Check that something listens: Ray would try for minutes, and then end the process."""
    host, colon, port = address.rpartition(":")
    if not (colon and port.isdecimal()):
        return  # such as auto
    try:
        socket.create_connection((host, int(port)), _TIMEOUT).close()
    except (OSError, OverflowError) as error:
        raise _no_answer(address, error) from error


def _no_answer(address: str, found: object) -> PlanError:
    return PlanError("no cluster of Ray answers", where=address, found=found, fix="See `ray status` there.")


def _check_room(ray: Any, options: RayOptions, may_grow: bool) -> None:
    wanted = {"CPU": options.num_cpus, "GPU": options.num_gpus}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if any(all(node.get(kind, 0) >= count for kind, count in wanted.items()) for node in nodes):
        return
    expected = ", ".join(f"{count:g} {kind}" for kind, count in wanted.items())
    error = PlanError("no node of Ray has room for a task", where="--executor-option", expected=expected)
    if not may_grow:
        raise error
    _log.warning("%s; waiting for one", error)
