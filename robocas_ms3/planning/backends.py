"""Motion planners by name, and those of other packages (entry points ``robocas_ms3.planners``)."""

from __future__ import annotations

from collections.abc import Callable

from robocas_ms3.core.extensions import Registry
from robocas_ms3.planning.protocol import Planner
from robocas_ms3.planning.rrt_connect import RRTConnectPlanner
from robocas_ms3.robots.table import RobotSpec

DEFAULT = "rrt_connect"
BACKENDS: Registry[Callable[..., Planner]] = Registry(
    "planner", "robocas_ms3.planners", Callable, {DEFAULT: RRTConnectPlanner}
)


def make_planner(name: str, robot: RobotSpec, *, dt: float) -> Planner:
    """Make the planner of a name.

    Args:
        name: one of ``BACKENDS``.
        robot: whose arm it plans for.
        dt: seconds between rows of a trajectory.

    Raises:
        ExtensionError: there is no such planner, or another package's can't be loaded.
        RobocasError: it can't load the robot's files.
    """
    backend, files = BACKENDS.find(name, where="planner"), robot.files()
    return backend(files.arm_urdf, files.arm_srdf, robot=robot.description, dt=dt)
