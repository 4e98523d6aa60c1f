"""End-effector controller: deltas in the end-effector frame (`ee_deltas`), or absolute poses.

Deltas are added to the last target pose, not to the current pose: otherwise the tracking errors of recorded motions
would add up to centimetres within seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from mani_skill.agents.controllers import PDEEPosController, PDEEPoseController, PDEEPoseControllerConfig
from mani_skill.utils.structs import Link, Pose

from robocas_ms3.core import rotations
from robocas_ms3.core.arrays import (
    as_float32,
    as_float64,
    as_tensor,
    clamp,
    concatenate,
    known_all_false,
    known_all_true,
    norm,
    to_native,
    where,
)
from robocas_ms3.core.errors import RobocasError
from robocas_ms3.robots.drives import ARM_RESET_DISTANCE, InterpolatedDrives
from robocas_ms3.robots.ee_deltas import apply_ee_delta
from robocas_ms3.robots.kinematics import SerialChain

BODY_FRAME = "body_translation:body_aligned_body_rotation"
# m and rad between the TCP and its target pose; beyond, the arm is blocked or its state was set
EE_MAX_LAG = (0.1, 0.5)


def relative_pose(frame: Link, link: Link) -> Pose:
    """Return the poses (N,) of ``link`` in the frame of the link ``frame``."""
    return Pose(raw_pose=as_tensor(_relative_pose_array(frame, link)))


def _relative_pose_array(frame: Link, link: Link) -> Any:
    """Return the poses (N, 7) of ``link`` in the frame of the link ``frame`` as a native array.

    On a CPU, SAPIEN is ten times faster than tensors.
    """
    if frame.scene.gpu_sim_enabled:
        base, pose = frame.pose, link.pose  # ManiSkill's pose product synchronizes with the GPU
        inverse = torch.cat([base.q[:, :1], -base.q[:, 1:]], dim=1)
        return concatenate([rotations.rotate_float64(inverse, pose.p - base.p), rotations.multiply(inverse, pose.q)])
    pose = frame._bodies[0].entity_pose.inv() * link._bodies[0].entity_pose
    position, quaternion = pose.p, pose.q
    if quaternion[0] < 0:  # as in ManiSkill's products
        quaternion = np.negative(quaternion)
    return np.concatenate([position, quaternion])[None]


class _ArmChainController(PDEEPoseController):
    """ManiSkill's end-effector controller with inverse kinematics by `SerialChain`.

    ManiSkill's solver ignores joint limits on a CPU. On a GPU it waits for the device and does only one iteration.
    """

    def _initialize_joints(self) -> None:
        super(
            PDEEPosController, self
        )._initialize_joints()  # skips the method of PDEEPosController, which builds ManiSkill's kinematics
        self.initial_qpos = None
        links = self.articulation.links_map
        self.ee_link, self.root_link = links[self.config.ee_link], links[cast("str", self.config.root_link_name)]
        device = self.device if self.scene.gpu_sim_enabled else None
        self._chain = SerialChain(self.config.urdf_path, self.root_link.name, self.ee_link.name, device)
        names = tuple(joint.name for joint in self.joints)
        if names != self._chain.joint_names:
            expected = ", ".join(self._chain.joint_names)
            what = "the joints of the controller differ from the joints of the arm's URDF"
            raise RobocasError(what, where=self.config.urdf_path, expected=expected, found=", ".join(names))
        limits = as_float64(to_native(self.articulation.get_qlimits()[0, self.active_joint_indices]))
        self._lower, self._upper = limits[:, 0], limits[:, 1]

    def _solve(self, target: Any, qpos: Any) -> tuple[Any, Any]:
        """Solve inverse kinematics for target poses (N, 7), starting from ``qpos`` (N, joints).

        Returns:
            Joint positions (N, joints), and for each env (N,) whether they reach the target.
        """
        target = as_float64(target)
        qpos, solved = self._chain.solve_inverse(
            target[:, :3], target[:, 3:], as_float64(qpos), self._lower, self._upper
        )
        return as_float32(qpos), solved


class RoboCASEEPoseController(InterpolatedDrives, _ArmChainController):
    """End-effector controller with deltas or absolute poses.

    Deltas are in the end effector's frame, absolute poses in the arm's base frame.

    Differences from ManiSkill's controller:

    - A positive angle is a positive rotation.
    - Body-frame deltas also work on a GPU: the target pose in the base frame is computed before inverse kinematics.
    - If the arm is blocked, the target is reset to the current pose, so that deltas do not accumulate.
    - For deltas, position and velocity targets of the drives are interpolated within a control step, so that the TCP
      moves uniformly and reaches the target at the end of the step.
    """

    def _clip_and_scale_action(self, action: Any) -> Any:
        position, rotation = clamp(action[:, :3], -1, 1), action[:, 3:]
        rotation = rotation / clamp(norm(rotation)[:, None], 1.0, np.inf)
        return self._middle + self._half * concatenate([position, rotation])

    def _target_from_action(self, reference: Any, action: Any) -> Any:
        """Convert actions (N, 6) in m and rad to target poses (N, 7) in the arm's base frame.

        Actions are deltas that are applied to the poses ``reference`` (N, 7), or absolute poses if it is None.
        """
        if reference is not None:
            return concatenate([*apply_ee_delta(reference[:, :3], reference[:, 3:], action)])
        return concatenate([action[:, :3], rotations.from_euler(action[:, 3:6])])

    sets_target_qvel = True

    def set_action(self, action: Any) -> None:
        """Set the drive targets for the target pose of an action (N, size).

        An env whose target pose inverse kinematics does not reach holds its current joint positions.
        """
        action = self._scale_action(action)
        reference = self._reference_pose_array() if self.config.use_delta else None
        last = now = self._current_qpos()
        if self._target_qpos is not None:
            last = to_native(self._target_qpos)
        start = where(abs(last - now) > ARM_RESET_DISTANCE, now, last)
        wanted = self._target_from_action(reference, action)
        target, solved = self._solve(wanted, now)
        if not known_all_true(solved):
            stay = self._reference_pose_array() if reference is None else reference
            target, wanted = where(solved[:, None], target, now), where(solved[:, None], wanted, stay)
        self._target_pose, self._target_qpos = Pose(raw_pose=as_tensor(wanted)), as_tensor(target)
        if self.config.use_delta:
            self._set_targets(start, (target - start) * self._control_freq)
            self._interpolate(start, target)
        else:
            self._set_targets(target, torch.zeros_like(as_tensor(target)))

    def _set_targets(self, targets: Any, velocities: Any) -> None:
        """Set position and velocity targets (N, joints) of the drives. Velocity targets avoid a tracking lag."""
        self.set_drive_targets(targets)
        self.set_drive_velocities(velocities)

    def reference_pose(self) -> Pose:
        """Return the poses (N,) in the arm's base frame to which the next action, a delta, is applied."""
        return Pose(raw_pose=as_tensor(self._reference_pose_array()))

    def _reference_pose_array(self) -> Any:
        now = _relative_pose_array(cast("Link", self.root_link), self.ee_link)
        if not self.config.use_target or self._target_pose is None:
            return now
        max_distance, max_angle = EE_MAX_LAG
        target = to_native(self._target_pose.raw_pose)
        distance = norm(target[:, :3] - now[:, :3])
        cosine = abs((target[:, 3:] * now[:, 3:]).sum(1))  # cosine of half the angle between the poses
        lost = (distance > max_distance) | (cosine < np.cos(max_angle / 2))
        if known_all_false(lost):
            return target
        return where(lost[:, None], now, target)


@dataclass
class RoboCASEEPoseControllerConfig(PDEEPoseControllerConfig):
    """Configuration of a ``RoboCASEEPoseController``. The rotation bounds must be symmetric."""

    controller_cls = RoboCASEEPoseController
