"""Registry of robots: builtin robots and those of other packages (entry points ``robocas_ms3.robots``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from robocas_ms3.core.errors import ExtensionError
from robocas_ms3.core.extensions import Registry
from robocas_ms3.robots.description import MOBILE_PANDA, RobotDescription
from robocas_ms3.robots.urdf import RobotFiles, make_robot_files


@dataclass(frozen=True)
class RobotSpec:
    """Registry entry of a robot. It can be imported without a simulator.

    Attributes:
        description: names, limits and dimensions; ``description.uid`` is the name of the robot in the registry.
        files: function without arguments that generates missing URDF files and returns their paths.
        agent: import path of the ManiSkill agent, a subclass of `robots.agent.MobileManipulator`.
    """

    description: RobotDescription
    files: Callable[[], RobotFiles]
    agent: str


PANDA = RobotSpec(MOBILE_PANDA, make_robot_files, "robocas_ms3.robots.agent:RoboCASMobilePanda")
STOCK_FINGERS = RobotSpec(
    replace(MOBILE_PANDA, uid=f"{MOBILE_PANDA.uid}_stock_fingers", finger_extension=0.0),
    partial(make_robot_files, 0.0),
    "robocas_ms3.robots.agent:RoboCASMobilePandaStockFingers",
)
DEFAULT_ROBOT = MOBILE_PANDA.uid
ROBOTS = Registry(
    "robot", "robocas_ms3.robots", RobotSpec, {spec.description.uid: spec for spec in (PANDA, STOCK_FINGERS)}
)


def find_robot(name: str | None, *, where: object = "robot", usage: bool = True) -> RobotSpec:
    """Return the registered robot of this name, or the default robot for None.

    ``usage``: whether the user passed the name; False if a file contains it (`RobocasError.usage`).
    """
    spec = ROBOTS.find(name or DEFAULT_ROBOT, where=where, usage=usage)
    if spec.description.uid != (name or DEFAULT_ROBOT):
        fix = "Rename the entry point to the uid in the robot's description."
        raise ExtensionError(
            "the name of the entry point differs from the uid of the robot",
            where=where,
            expected=spec.description.uid,
            found=name,
            fix=fix,
        )
    return spec
