"""The baselines by name, each imported when it is used; other packages add theirs by entry points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

from robocas_ms3.core.errors import TrainingError, require_extra
from robocas_ms3.core.extensions import Registry
from robocas_ms3.core.signals import forbid_exit
from robocas_ms3.core.text import did_you_mean

if TYPE_CHECKING:
    from robocas_ms3.baselines.baseline import Baseline  # which imports torch

GROUP = "robocas_ms3.baselines"


@dataclass(frozen=True)
class Builtin:
    """Imports a baseline of this package.

    Attributes:
        folder: next to this file.
        about: a line for `robocas list`.
    """

    folder: str
    about: str

    def __call__(self) -> Baseline:
        return import_module(f"robocas_ms3.baselines.{self.folder}").BASELINE


BASELINES: Registry[Callable[[], Baseline]] = Registry(
    "baseline",
    GROUP,
    Callable,
    {
        "small": Builtin("small", "base and gripper camera, language; chunks of poses by a small transformer"),
        "bc-state": Builtin("bc_state", "privileged state of the simulator; chunks of poses by residual layers"),
        "rt1": Builtin("rt1", "RT-1 of the paper: base and gripper camera, language; action tokens by a transformer"),
        "ppo": Builtin("ppo", "reinforcement learning from dense rewards and privileged state; no data"),
    },
)
"""Functions that return a baseline, by its name."""


def find_baseline(name: str, *, where: object = "") -> Baseline:
    """Return the baseline of a name."""
    if name not in BASELINES:
        known = list(BASELINES)
        expected = f"one of {', '.join(known)}"
        raise TrainingError("no such baseline", where=where or name, expected=expected, fix=did_you_mean(name, known))
    require_extra("train", "baselines", "safetensors")
    with forbid_exit(f"baseline {name}"):
        return BASELINES[name]()
