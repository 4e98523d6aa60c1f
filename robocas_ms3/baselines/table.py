"""The baselines by name, each imported when it is asked for; other packages bring theirs as entry points."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from robocas_ms3.baselines.baseline import Baseline
from robocas_ms3.errors import MissingExtraError, TrainingError
from robocas_ms3.extensions import Table
from robocas_ms3.strict import nearest

GROUP = "robocas_ms3.baselines"


def _builtin(folder: str) -> Callable[[], Baseline]:
    def made() -> Baseline:
        return import_module(f"robocas_ms3.baselines.{folder}").BASELINE

    return made


BASELINES: Table[Callable[[], Baseline]] = Table(
    "baseline",
    GROUP,
    Callable,
    {"small": _builtin("small"), "bc-state": _builtin("bc_state"), "rt1": _builtin("rt1"), "ppo": _builtin("ppo")},
)
"""By name, what gives it."""


def find_baseline(name: str, *, where: object = "") -> Baseline:
    """The baseline of a name.

    Raises:
        TrainingError: there is none.
        MissingExtraError: the ``train`` extra is not installed.
    """
    if name not in BASELINES:
        known = list(BASELINES)
        expected = f"one of {', '.join(known)}"
        raise TrainingError("no such baseline", where=where or name, expected=expected, fix=nearest(name, known))
    need_extra()
    found: Any = BASELINES[name]()
    return found


def need_extra() -> None:
    """See that what baselines are trained with is installed.

    Raises:
        MissingExtraError: it is not.
    """
    for module in ("accelerate", "safetensors", "tensorboard", "transformers"):
        try:
            import_module(module)
        except ModuleNotFoundError as error:
            fix = 'Run pip install "robocas-ms3[train]".'
            raise MissingExtraError("baselines need an extra", found=f"no {error.name}", fix=fix) from error
