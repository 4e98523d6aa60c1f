"""Scripted policy of pick: grasp the target, lift it, carry it above the basket, let go, step back."""

from __future__ import annotations

from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.skills.base_placement import bring_to_basket, grasp_from_reach


def attempt(arm: Arm) -> None:
    arm.begin_subgoal("move and grasp")
    grasp_from_reach(arm, arm.target)
    arm.executor.check_open_loop()
    bring_to_basket(arm, arm.target)
