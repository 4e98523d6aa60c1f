"""Policies by name: builtin ones, those of installed packages, ``replay:DATASET``, ``module:Class``, ``ws://host:port``.

A package offers policies as entry points of the group `GROUP`: see docs/extending.md. Folders that hold a policy, such
as the runs of `robocas train`, are opened by entry points of the group `FOLDERS_GROUP`, named by a file in them.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.exits import no_exit
from robocas_ms3.core.extensions import Registry
from robocas_ms3.core.strict import nearest
from robocas_ms3.evaluation.policies.plain import RandomPolicy, StillPolicy
from robocas_ms3.evaluation.policy import Policy, PolicySpec

GROUP = "robocas_ms3.policies"
FOLDERS_GROUP = "robocas_ms3.policy_folders"


def _scripted(speaks: Literal["joint_positions", "robocas"], *, beside: bool = False) -> Policy:
    from robocas_ms3.evaluation.policies.scripted import ScriptedPolicy

    return ScriptedPolicy(speaks, beside=beside)


POLICIES: Registry[Callable[[], Policy]] = Registry(
    "policy",
    GROUP,
    Callable,
    {
        "scripted": partial(_scripted, "joint_positions"),
        "scripted-motions": partial(_scripted, "robocas"),
        "scripted-beside": partial(_scripted, "robocas", beside=True),
        "random": RandomPolicy,
        "still": StillPolicy,
    },
)
"""By name, what makes them."""
FOLDERS: Registry[Callable[[Path], Policy]] = Registry("kind of policy folder", FOLDERS_GROUP, Callable, {})
"""By a file that such a folder holds, what opens it."""


def make_policy(name: str) -> Policy:
    """Make a policy.

    Args:
        name: of a builtin one, or of one that a package brings; ``replay:TRAJECTORY.h5``; ``module:Class`` of your
            own, called without arguments; a folder of `robocas train`; or the address of a server
            (`remote.address.read_address`).

    Raises:
        EvaluationError: there is no such policy, or it is none.
        ExtensionError: that of a package can't be loaded, or several have it.
        MissingExtraError: it is elsewhere, and the ``remote`` extra is not installed.
    """
    with no_exit(f"policy {name}"):
        policy = _made(name)
        _check(policy, name)
    return policy


def _check(policy: Any, name: str) -> None:
    """Check that a policy has what `Policy` asks for.

    Raises:
        EvaluationError: it hasn't.
    """
    for what, fits in (
        ("spec", isinstance(getattr(policy, "spec", None), PolicySpec)),
        ("reset", callable(getattr(policy, "reset", None))),
        ("act", callable(getattr(policy, "act", None))),
    ):
        if not fits:
            expected = "spec (robocas_ms3.evaluation.policy.PolicySpec), reset(starts) and act(observations)"
            raise EvaluationError(f"a policy without {what}", where=name, expected=expected)


def check_policy(name: str) -> None:
    """Check that a name can be a policy's, without making that.

    Raises:
        EvaluationError: it can't.
    """
    kind, _, rest = name.partition(":")
    known = [*POLICIES.builtin, *POLICIES.entry_points]
    of_own = re.fullmatch(r"\w+(\.\w+)*", kind) and rest.isidentifier()
    if not (name in known or of_own or (kind in ("ws", "wss", "replay") and rest) or _opener(name)):
        expected = (
            f"{', '.join(known)}, a folder of robocas train, replay:TRAJECTORY.h5, module:Class or ws://host:port"
        )
        raise EvaluationError("no such policy", where=name, expected=expected, fix=nearest(name, known))


def _made(name: str) -> Policy:
    check_policy(name)
    if name in POLICIES.builtin:
        return POLICIES[name]()
    kind, _, rest = name.partition(":")
    if kind in ("ws", "wss") and rest:
        from robocas_ms3.evaluation.remote.client import RemotePolicy

        return RemotePolicy(name)
    if kind == "replay" and rest:
        from robocas_ms3.evaluation.policies.replay import ReplayPolicy

        return ReplayPolicy(Path(rest))
    if name in POLICIES:
        return _call(name, POLICIES[name])
    if opener := _opener(name):
        return FOLDERS[opener](Path(name))
    return _own(name, kind, rest)


def _opener(name: str) -> str:
    """Which of `FOLDERS` opens a folder of this name; empty: none."""
    folder = Path(name)
    return next((file for file in FOLDERS.entry_points if (folder / file).is_file()), "") if folder.is_dir() else ""


def _own(name: str, module: str, of: str) -> Policy:
    """A policy of the user's own, from an installed module or one in the folder that the command runs in."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # the last: what lies about must not stand in for what is installed
    try:
        made: Any = getattr(importlib.import_module(module), of)
    except ModuleNotFoundError as error:
        if module.endswith(".py"):
            raise EvaluationError("no such policy", where=name, fix=f"Leave the .py out: {module[:-3]}:{of}") from error
        if error.name != module.partition(".")[0]:
            raise EvaluationError("this policy's module can't be imported", where=module, found=error) from error
        fix = "Run in its folder, or install it, or put its folder on PYTHONPATH."
        raise EvaluationError("no such policy", where=name, found=error, fix=fix) from error
    except AttributeError as error:
        raise EvaluationError("no such policy", where=name, found=error) from error
    except Exception as error:
        what, found = "this policy's module can't be imported", f"{type(error).__name__}: {error}"
        raise EvaluationError(what, where=module, found=found) from error
    return _call(name, made)


def _call(name: str, made: Any) -> Policy:
    try:
        return made()
    except TypeError as error:
        if error.__traceback__ is not None and error.__traceback__.tb_next is None:  # it was not even begun
            what, expected = "this policy can't be made", "a class that takes no arguments"
            raise EvaluationError(what, where=name, expected=expected, found=error) from error
        raise


@contextmanager
def open_policy(name: str) -> Iterator[Policy]:
    """Make a policy, and close it in the end if it can be closed.

    Raises:
        ExtensionError: its code tried to end the process, wherever it is called inside.
    """
    with no_exit(f"policy {name}"):
        policy = make_policy(name)
        try:
            yield policy
        finally:
            close = getattr(policy, "close", None)
            if close is not None:
                close()
