"""The robots: a row each, and those of other packages (entry points ``robocas_ms3.robots``)."""

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
    """A robot, declared without a simulator.

    Attributes:
        description: its names, limits and numbers; its ``uid`` is the row's name.
        files: gives its URDF files, made where they are missing.
        agent: import path of its ManiSkill agent, a `robots.agent.MobileManipulator`.
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
    "robot", "robocas_ms3.robots", RobotSpec, {row.description.uid: row for row in (PANDA, STOCK_FINGERS)}
)


def find_robot(name: str | None, *, where: object = "robot") -> RobotSpec:
    """The robot of a name; None: the default one."""
    spec = ROBOTS.find(name or DEFAULT_ROBOT, where=where)
    if spec.description.uid != (name or DEFAULT_ROBOT):
        fix = "Name its entry point as its description's uid."
        raise ExtensionError("a robot by another name", where=where, expected=spec.description.uid, found=name, fix=fix)
    return spec
