"""Registry of the baselines.

A baseline is imported at its first use. Other packages register their baselines by entry points.
"""

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
class BuiltinBaseline:
    """Function that imports a baseline of this package and returns it.

    Attributes:
        folder: name of the module or package in `robocas_ms3.baselines`.
        description: line of text for `robocas list`.
    """

    folder: str
    description: str

    def __call__(self) -> Baseline:
        return import_module(f"robocas_ms3.baselines.{self.folder}").BASELINE


BASELINES: Registry[Callable[[], Baseline]] = Registry(
    "baseline",
    GROUP,
    Callable,
    {
        "small": BuiltinBaseline(
            "small", "base and gripper camera, language; action chunks by a small transformer; bundled weights for pick"
        ),
        "keyframe": BuiltinBaseline(
            "keyframe",
            "RGB-D images of three cameras, language; next keyframe by segmentation and ranked grasps; bundled weights "
            "for all tasks",
        ),
        "bc-state": BuiltinBaseline("bc_state", "privileged state of the simulator; action chunks by a residual MLP"),
        "rt1": BuiltinBaseline(
            "rt1", "RT-1 of the RoboCAS paper: base and gripper camera, language; action tokens by a transformer"
        ),
        "ppo": BuiltinBaseline("ppo", "reinforcement learning from dense rewards and privileged state; needs no data"),
    },
)
"""By name of a baseline, function that imports and returns it."""


def find_baseline(name: str, *, where: object = "") -> Baseline:
    """Import and return the baseline with a name.

    where: place of the name, such as a file; errors show it.

    Raises:
        TrainingError: there is no baseline of this name.
        MissingExtraError: the extra ``train`` is not installed.
    """
    if name not in BASELINES:
        known = list(BASELINES)
        expected = f"one of {', '.join(known)}"
        raise TrainingError("unknown baseline", where=where or name, expected=expected, fix=did_you_mean(name, known))
    require_extra("train", "baselines", "safetensors")
    with forbid_exit(f"baseline {name}"):
        return BASELINES[name]()
