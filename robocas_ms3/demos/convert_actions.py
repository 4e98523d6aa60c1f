"""Turn recorded ``pd_joint_pos`` actions into those of other control modes, while the episode is simulated again.

ManiSkill's own converter can't do it for this robot: it wants end-effector deltas in the root's axes and measures them
in the world's, so it refuses the end effector's own frame and goes wrong when the robot doesn't face along x.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from robocas_ms3.core.poses import from_wxyz, inverse
from robocas_ms3.robots.ee_controller import RoboCASEEPoseController
from robocas_ms3.robots.ee_deltas import to_ee_delta_action
from robocas_ms3.robots.forward import chain
from robocas_ms3.tasks.base import RoboCASEnv

_JOINT_DELTA_SCALE = 0.1  # rad at |action| = 1 of pd_joint_delta_pos
CONVERTIBLE = ("pd_joint_pos", "pd_joint_delta_pos", "pd_ee_delta_pose", "pd_ee_pose")


def convert_action(action: np.ndarray, env: RoboCASEnv) -> np.ndarray:
    """Convert a recorded action, from what it commanded and where the robot is now.

    Args:
        action: (8,) 7 joint targets in rad, gripper command.
        env: the environment the new action is for (one env), its control mode among ``CONVERTIBLE``.

    Returns:
        The action of the environment's control mode, within its bounds.
    """
    arm, gripper, robot = action[:7].astype(float), action[7:], env.robot_spec.description
    if env.control_mode == "pd_joint_pos":
        return action
    if env.control_mode == "pd_joint_delta_pos":
        now = env.agent.robot.get_qpos()[0, robot.arm_slice].cpu().numpy()
        return np.append(np.clip((arm - now) / _JOINT_DELTA_SCALE, -1, 1), gripper).astype(np.float32)
    tcp_in_base = chain(env.robot_spec.files().urdf, robot.arm_base_link, robot.tcp_link, arm[None])[0]
    if env.control_mode == "pd_ee_pose":
        euler = Rotation.from_matrix(tcp_in_base[:3, :3]).as_euler("XYZ")
        return np.concatenate([tcp_in_base[:3, 3], euler, gripper]).astype(np.float32)
    agent: Any = env.agent
    controller = agent.controller.controllers["arm"]
    assert isinstance(controller, RoboCASEEPoseController)
    motion = inverse(from_wxyz(controller.reference_pose().raw_pose[0].cpu())) @ tcp_in_base
    delta = to_ee_delta_action(motion[:3, 3], Rotation.from_matrix(motion[:3, :3]))
    return np.append(np.clip(delta, -1, 1), gripper).astype(np.float32)
