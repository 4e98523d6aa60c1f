"""Motion planners by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from robocas_ms3.errors import RobocasError
from robocas_ms3.planning.mplib_backend import MplibPlanner
from robocas_ms3.planning.protocol import Planner

BACKENDS: dict[str, Callable[..., Planner]] = {"mplib": MplibPlanner}
DEFAULT = "mplib"


def make_planner(name: str, arm_urdf: Path | str, arm_srdf: Path | str, *, dt: float) -> Planner:
    """Make the planner of a name.

    Args:
        name: one of ``BACKENDS``.
        arm_urdf: the arm alone, rooted at ``panda_link0``.
        arm_srdf: its pairs of links that may touch.
        dt: seconds between rows of a trajectory.

    Raises:
        RobocasError: there is no such planner, or it can't load the description.
    """
    if name not in BACKENDS:
        raise RobocasError("no such planner", where="planner", expected=", ".join(BACKENDS), found=name)
    return BACKENDS[name](arm_urdf, arm_srdf, dt=dt)
