"""Turn recorded ``pd_joint_pos`` actions into those of other control modes, while the episode is simulated again.

ManiSkill's own converter can't do it for this robot: it wants end-effector deltas in the root's axes and measures them
in the world's, so it refuses the end effector's own frame and goes wrong when the robot doesn't face along x.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from sapien.wrapper.pinocchio_model import PinocchioModel
from scipy.spatial.transform import Rotation

from robocas_ms3.errors import DatasetError
from robocas_ms3.robots import constants as c
from robocas_ms3.robots.ee_controller import RoboCASEEPoseController
from robocas_ms3.robots.ee_deltas import to_ee_delta_action
from robocas_ms3.robots.urdf import robot_files
from robocas_ms3.tasks.base import RoboCASEnv

_JOINT_DELTA_SCALE = 0.1  # rad at |action| = 1 of pd_joint_delta_pos
CONVERTIBLE = ("pd_joint_pos", "pd_joint_delta_pos", "pd_ee_delta_pose", "pd_ee_pose")


class ActionConverter:
    """Converts one action at a time, from what the recording commanded and where the robot is now.

    Args:
        env: the environment the new actions are for (one env).

    Raises:
        DatasetError: the environment's control mode is not among ``CONVERTIBLE``.
    """

    def __init__(self, env: RoboCASEnv) -> None:
        self.env = env
        self.mode = env.control_mode
        if self.mode not in CONVERTIBLE:
            raise DatasetError("can't convert to this control mode", expected=f"one of {CONVERTIBLE}", found=self.mode)
        urdf = str(robot_files().arm_urdf)
        with open(urdf, encoding="utf-8") as file:
            self._model = PinocchioModel(file.read(), [0, 0, -9.81])
        joints, links = [*c.ARM_JOINTS, *c.FINGER_JOINTS], [link.name for link in env.agent.robot.links]
        self._model.set_joint_order(joints)
        in_arm = links[links.index(c.ARM_BASE_LINK) :]
        self._model.set_link_order(in_arm)
        self._tcp_index = in_arm.index(c.TCP_LINK)

    def __call__(self, action: np.ndarray) -> np.ndarray:
        """Convert one recorded action.

        Args:
            action: (8,) 7 joint targets in rad, gripper command.

        Returns:
            The action of this environment's control mode, within its bounds.
        """
        arm, gripper = action[:7].astype(float), action[7:]
        if self.mode == "pd_joint_pos":
            return action
        if self.mode == "pd_joint_delta_pos":
            now = self.env.agent.robot.get_qpos()[0, c.ARM_SLICE].cpu().numpy()
            return np.append(np.clip((arm - now) / _JOINT_DELTA_SCALE, -1, 1), gripper).astype(np.float32)
        position, rotation = self._tcp(arm)
        if self.mode == "pd_ee_pose":
            return np.concatenate([position, rotation.as_euler("XYZ"), gripper]).astype(np.float32)
        agent: Any = self.env.agent
        controller = agent.controller.controllers["arm"]
        assert isinstance(controller, RoboCASEEPoseController)
        pose = controller.reference_pose().raw_pose[0].cpu().numpy().astype(float)
        now_inverse = Rotation.from_quat(pose[[4, 5, 6, 3]]).inv()
        delta = to_ee_delta_action(now_inverse.apply(position - pose[:3]), now_inverse * rotation)
        return np.append(np.clip(delta, -1, 1), gripper).astype(np.float32)

    def _tcp(self, arm: np.ndarray) -> tuple[np.ndarray, Rotation]:
        self._model.compute_forward_kinematics(np.concatenate([arm, [c.OPEN_FINGER] * 2]))
        pose = self._model.get_link_pose(self._tcp_index)
        return np.asarray(pose.p, dtype=float), Rotation.from_quat(np.asarray(pose.q)[[1, 2, 3, 0]])
