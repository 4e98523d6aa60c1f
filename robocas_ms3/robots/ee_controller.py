"""Controller of the end effector: deltas in its own frame (`ee_deltas`), or absolute poses.

Deltas start from the pose that the last action asked for, not from where the arm is: what it falls short of a target
would add up over the steps of recorded poses, to centimetres within seconds.
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
    as_double,
    as_float,
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
from robocas_ms3.robots.ee_deltas import ee_delta_target
from robocas_ms3.robots.kinematics import SerialChain

BODY_FRAME = "body_translation:body_aligned_body_rotation"
# m and rad between the TCP and the pose it was asked for: beyond, something holds the arm back, or set it elsewhere.
EE_MAX_LAG = (0.1, 0.5)


def relative_pose(frame: Link, link: Link) -> Pose:
    """(N,) poses of a link in the frame of another; on a CPU by SAPIEN, ten times faster than by tensors."""
    return Pose(raw_pose=as_tensor(_relative_pose(frame, link)))


def _relative_pose(frame: Link, link: Link) -> Any:
    """(N, 7) native (`arrays`) poses of a link in the frame of another."""
    if frame.scene.gpu_sim_enabled:
        base, pose = frame.pose, link.pose  # ManiSkill's own product waits for the GPU
        inverse = torch.cat([base.q[:, :1], -base.q[:, 1:]], dim=1)
        return concatenate([rotations.rotate_float64(inverse, pose.p - base.p), rotations.multiply(inverse, pose.q)])
    pose = frame._bodies[0].entity_pose.inv() * link._bodies[0].entity_pose
    position, quaternion = pose.p, pose.q
    if quaternion[0] < 0:  # as ManiSkill's products
        quaternion = np.negative(quaternion)
    return np.concatenate([position, quaternion])[None]


class _ArmChainController(PDEEPoseController):
    """ManiSkill's controller with a `SerialChain` in place of its kinematics.

    ManiSkill's solver knows no joint limits on a CPU; on a GPU it waits for the device and takes a single step.
    """

    def _initialize_joints(self) -> None:
        super(PDEEPosController, self)._initialize_joints()  # not that class' own, which builds the kinematics
        self.initial_qpos = None
        links = self.articulation.links_map
        self.ee_link, self.root_link = links[self.config.ee_link], links[cast("str", self.config.root_link_name)]
        device = self.device if self.scene.gpu_sim_enabled else None
        self._chain = SerialChain(self.config.urdf_path, self.root_link.name, self.ee_link.name, device)
        names = tuple(joint.name for joint in self.joints)
        if names != self._chain.joint_names:
            what, expected = "the controlled joints are not those of the arm", ", ".join(self._chain.joint_names)
            raise RobocasError(what, where=self.config.urdf_path, expected=expected, found=", ".join(names))
        limits = as_double(to_native(self.articulation.get_qlimits()[0, self.active_joint_indices]))
        self._lower, self._upper = limits[:, 0], limits[:, 1]

    def _solve(self, target: Any, qpos: Any) -> tuple[Any, Any]:
        """Return arm positions (N, joints) near ``qpos`` for targets (N, 7), and whether (N,) they reach them."""
        target = as_double(target)
        qpos, solved = self._chain.inverse(target[:, :3], target[:, 3:], as_double(qpos), self._lower, self._upper)
        return as_float(qpos), solved


class RoboCASEEPoseController(InterpolatedDrives, _ArmChainController):
    """End-effector pose control: deltas in the end effector's frame, or absolute poses in the arm's base frame.

    Differs from ManiSkill's: rotations have their natural sign; body-frame deltas work on a GPU too, since the target
    pose in the base frame is computed before inverse kinematics; and a target that the arm does not come near to is
    given up, so that deltas don't pile up while something is in the way. Within a control step the drive target of
    deltas moves evenly, with its velocity, so that the TCP goes evenly from pose to pose, as it did when these poses
    were recorded, and is there when the step ends.
    """

    def _clip_and_scale_action(self, action: Any) -> Any:
        position, rotation = clamp(action[:, :3], -1, 1), action[:, 3:]
        rotation = rotation / clamp(norm(rotation)[:, None], 1.0, np.inf)
        return self._middle + self._half * concatenate([position, rotation])

    def _wanted_pose(self, reference: Any, action: Any) -> Any:
        """Return targets (N, 7) in the arm's base frame of actions (N, 6), m and rad, relative to a pose or not."""
        if reference is not None:
            return concatenate([*ee_delta_target(reference[:, :3], reference[:, 3:], action)])
        return concatenate([action[:, :3], rotations.from_euler(action[:, 3:6])])

    sets_target_qvel = True

    def set_action(self, action: Any) -> None:
        """Drive the arm towards the pose; where no inverse kinematics is found it stays where it is."""
        action = self._taken(action)
        reference = self._reference_pose() if self.config.use_delta else None
        last = now = self._now()
        if self._target_qpos is not None:
            last = to_native(self._target_qpos)
        start = where(abs(last - now) > ARM_RESET_DISTANCE, now, last)
        wanted = self._wanted_pose(reference, action)
        target, solved = self._solve(wanted, now)
        if not known_all_true(solved):
            stay = self._reference_pose() if reference is None else reference
            target, wanted = where(solved[:, None], target, now), where(solved[:, None], wanted, stay)
        self._target_pose, self._target_qpos = Pose(raw_pose=as_tensor(wanted)), as_tensor(target)
        if self.config.use_delta:
            self._drive_with(start, (target - start) * self._control_freq)
            self._move_evenly(start, target)
        else:
            self._drive_with(target, torch.zeros_like(as_tensor(target)))

    def _drive_with(self, targets: Any, velocities: Any) -> None:
        """Set drive targets and their velocities: an arm that is told its velocity does not lag."""
        self.set_drive_targets(targets)
        self.set_drive_velocities(velocities)

    def reference_pose(self) -> Pose:
        """(N,) poses in the arm's base frame that the next deltas start from."""
        return Pose(raw_pose=as_tensor(self._reference_pose()))

    def _reference_pose(self) -> Any:
        now = _relative_pose(cast("Link", self.root_link), self.ee_link)
        if not self.config.use_target or self._target_pose is None:
            return now
        far, turned = EE_MAX_LAG
        target = to_native(self._target_pose.raw_pose)
        distance = norm(target[:, :3] - now[:, :3])
        cosine = abs((target[:, 3:] * now[:, 3:]).sum(1))  # of half the angle between them
        lost = (distance > far) | (cosine < np.cos(turned / 2))
        if known_all_false(lost):
            return target
        return where(lost[:, None], now, target)


@dataclass
class RoboCASEEPoseControllerConfig(PDEEPoseControllerConfig):
    """Configuration of a ``RoboCASEEPoseController``. Rotation bounds must be symmetric."""

    controller_cls = RoboCASEEPoseController
