"""Policies by name: builtin ones, ``replay:DATASET``, ``module:Class``, or ``ws://host:port`` of a server."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from robocas_ms3.errors import EvaluationError
from robocas_ms3.evaluation.policies.plain import RandomPolicy, StillPolicy
from robocas_ms3.evaluation.policies.replay import ReplayPolicy
from robocas_ms3.evaluation.policies.scripted import ScriptedPolicy
from robocas_ms3.evaluation.policy import Policy

BUILTIN: dict[str, Callable[[], Policy]] = {
    "scripted": ScriptedPolicy,
    "scripted-motions": partial(ScriptedPolicy, "robocas"),
    "random": RandomPolicy,
    "still": StillPolicy,
}


def make_policy(name: str) -> Policy:
    """Make a policy.

    Args:
        name: of a builtin one; ``replay:TRAJECTORY.h5``; ``module:Class`` of your own, called without arguments;
            or the address of a server (`remote.address.read_address`).

    Raises:
        EvaluationError: there is no such policy.
        MissingExtraError: it is elsewhere, and the ``remote`` extra is not installed.
    """
    if name in BUILTIN:
        return BUILTIN[name]()
    kind, _, rest = name.partition(":")
    if kind in ("ws", "wss") and rest:
        from robocas_ms3.evaluation.remote.client import RemotePolicy

        return RemotePolicy(name)
    if kind == "replay" and rest:
        return ReplayPolicy(Path(rest))
    if not kind or not rest:
        expected = f"{', '.join(BUILTIN)}, replay:TRAJECTORY.h5, module:Class or ws://host:port"
        raise EvaluationError("no such policy", where=name, expected=expected)
    try:
        made: Any = getattr(importlib.import_module(kind), rest)
    except (ImportError, AttributeError) as error:
        raise EvaluationError("no such policy", where=name, found=error) from error
    return made()


@contextmanager
def open_policy(name: str) -> Iterator[Policy]:
    """Make a policy, and close it in the end if it can be closed."""
    policy = make_policy(name)
    try:
        yield policy
    finally:
        close = getattr(policy, "close", None)
        if close is not None:
            close()
