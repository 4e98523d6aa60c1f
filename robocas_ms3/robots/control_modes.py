"""The control modes of a robot: an arm, a gripper, and a base that is held or moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mani_skill.agents.controllers import PDJointPosControllerConfig

from robocas_ms3.robots.ee_controller import BODY_FRAME, RoboCASEEPoseControllerConfig
from robocas_ms3.robots.ee_deltas import POSITION_SCALE, ROTATION_SCALE
from robocas_ms3.robots.joint_controllers import (
    BASE_SCALE,
    JOINT_SCALE,
    FingersControllerConfig,
    HeldJointsControllerConfig,
    JointDeltaControllerConfig,
    SmoothJointPosControllerConfig,
)
from robocas_ms3.robots.table import RobotSpec

Drive = dict[str, Any]
"""Stiffness, damping and force limit of joints, in ManiSkill's units."""


@dataclass(frozen=True)
class Drives:
    """The drives of arm, gripper and base, and the greatest speed of the base, m/s and rad/s."""

    arm: Drive
    gripper: Drive
    base: Drive
    base_max_speed: float


def control_modes(spec: RobotSpec, drives: Drives, *, on_gpu: bool) -> dict[str, dict[str, Any]]:
    """Return the configurations of the controllers of each control mode, by name.

    Args:
        spec: the robot.
        drives: of its joints.
        on_gpu: whether the physics is on a GPU. On a CPU the arm of ``pd_joint_delta_pos`` has ManiSkill's own
            controller, whose exact class ManiSkill's replay tool asks for.
    """
    joint_deltas = JointDeltaControllerConfig if on_gpu else PDJointPosControllerConfig
    robot, arm, base = spec.description, drives.arm, drives.base
    arm_joints, base_joints, fingers = list(robot.arm_joints), list(robot.base_joints), list(robot.finger_joints)
    end_effector: dict[str, Any] = dict(
        joint_names=arm_joints,
        ee_link=robot.tcp_link,
        urdf_path=str(spec.files().arm_urdf),
        root_link_name=robot.arm_base_link,
        **arm,
    )
    arms = dict(
        pd_joint_pos=SmoothJointPosControllerConfig(arm_joints, None, None, **arm),
        pd_joint_delta_pos=joint_deltas(arm_joints, -JOINT_SCALE, JOINT_SCALE, use_delta=True, **arm),
        pd_ee_delta_pose=RoboCASEEPoseControllerConfig(
            pos_lower=-POSITION_SCALE,
            pos_upper=POSITION_SCALE,
            rot_lower=-ROTATION_SCALE,
            rot_upper=ROTATION_SCALE,
            frame=BODY_FRAME,
            use_target=True,
            **end_effector,
        ),
        pd_ee_pose=RoboCASEEPoseControllerConfig(
            pos_lower=-2.0, pos_upper=2.0, use_delta=False, normalize_action=False, **end_effector
        ),
    )
    low, high = robot.finger_targets
    mimic: dict[str, Any] = {fingers[1]: {"joint": fingers[0]}}
    hand = FingersControllerConfig(fingers, lower=low, upper=high, mimic=mimic, **drives.gripper)
    held = HeldJointsControllerConfig(base_joints, **base)
    moving: dict[str, Any] = {**base, "max_speed": drives.base_max_speed}
    moved = SmoothJointPosControllerConfig(base_joints, None, None, **moving)
    least, most = [-scale for scale in BASE_SCALE], list(BASE_SCALE)
    moved_by = SmoothJointPosControllerConfig(base_joints, least, most, use_delta=True, normalize_action=True, **moving)
    modes = {}
    for name, controller in arms.items():
        modes[name] = dict(arm=controller, gripper=hand, base=held)
    for name, controller in arms.items():
        modes[f"{name}_base"] = dict(arm=controller, gripper=hand, base=moved_by if "delta" in name else moved)
    return modes
