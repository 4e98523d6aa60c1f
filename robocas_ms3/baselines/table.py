"""The baselines by name, each imported when it is asked for; other packages bring theirs as entry points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

from robocas_ms3.core.errors import MissingExtraError, TrainingError
from robocas_ms3.core.exits import no_exit
from robocas_ms3.core.extensions import Registry

if TYPE_CHECKING:
    from robocas_ms3.baselines.baseline import Baseline  # which imports torch

GROUP = "robocas_ms3.baselines"


@dataclass(frozen=True)
class Builtin:
    """Gives a baseline of this package.

    Attributes:
        folder: beside this file.
        about: its own ``about``, for who does not import it.
    """

    folder: str
    about: str

    def __call__(self) -> Baseline:
        """The baseline."""
        return import_module(f"robocas_ms3.baselines.{self.folder}").BASELINE


BASELINES: Registry[Callable[[], Baseline]] = Registry(
    "baseline",
    GROUP,
    Callable,
    {
        "small": Builtin("small", "base and gripper camera, language; chunks of poses by a small transformer"),
        "bc-state": Builtin("bc_state", "what only a simulator knows; chunks of poses by residual layers"),
        "rt1": Builtin(
            "rt1", "the paper's RT-1: base and gripper camera, language; tokens of actions by a causal transformer"
        ),
        "ppo": Builtin("ppo", "learns by trying, from dense rewards and what only a simulator knows; no data"),
    },
)
"""By name, what gives it."""


def find_baseline(name: str, *, where: object = "") -> Baseline:
    """The baseline of a name.

    Raises:
        TrainingError: there is none.
        MissingExtraError: of the ``train`` extra is not installed what weights are read by.
    """
    if name not in BASELINES:
        from robocas_ms3.core.strict import nearest  # imports pydantic, which `robocas --help` does not need

        known = list(BASELINES)
        expected = f"one of {', '.join(known)}"
        raise TrainingError("no such baseline", where=where or name, expected=expected, fix=nearest(name, known))
    need_extra("safetensors")
    with no_exit(f"baseline {name}"):
        return BASELINES[name]()


def need_extra(*modules: str) -> None:
    """See that modules of the ``train`` extra are installed.

    Raises:
        MissingExtraError: one is not.
    """
    for module in modules:
        try:
            import_module(module)
        except ModuleNotFoundError as error:
            fix = 'In the clone: pip install -e ".[train]"'
            raise MissingExtraError("baselines need an extra", found=f"no {error.name}", fix=fix) from error
