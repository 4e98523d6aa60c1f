"""Motion planners by name, and those of other packages (entry points ``robocas_ms3.planners``)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from robocas_ms3.extensions import Table
from robocas_ms3.planning.mplib_backend import MplibPlanner
from robocas_ms3.planning.protocol import Planner

DEFAULT = "mplib"
BACKENDS: Table[Callable[..., Planner]] = Table("planner", "robocas_ms3.planners", Callable, {DEFAULT: MplibPlanner})


def make_planner(name: str, arm_urdf: Path | str, arm_srdf: Path | str, *, dt: float) -> Planner:
    """Make the planner of a name.

    Args:
        name: one of ``BACKENDS``.
        arm_urdf: the arm alone, rooted at ``panda_link0``.
        arm_srdf: its pairs of links that may touch.
        dt: seconds between rows of a trajectory.

    Raises:
        ExtensionError: there is no such planner, or another package's can't be loaded.
        RobocasError: it can't load the description.
    """
    return BACKENDS.find(name, where="planner")(arm_urdf, arm_srdf, dt=dt)
