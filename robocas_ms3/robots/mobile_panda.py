"""``robocas_mobile_panda``: a Franka Panda with lengthened finger tips on a mobile base, as a ManiSkill agent."""

from __future__ import annotations

from robocas_ms3.robots.agent import MobileManipulator
from robocas_ms3.robots.table import PANDA, STOCK_FINGERS


class RoboCASMobilePanda(MobileManipulator, spec=PANDA):
    """Mobile Panda."""


class RoboCASMobilePandaStockFingers(MobileManipulator, spec=STOCK_FINGERS):
    """The same robot with ManiSkill's own fingers, for comparison."""
