"""Controller of the end effector: deltas in its own frame (`ee_deltas`), or absolute poses.

Deltas start from the pose that the last action asked for, not from where the arm is: what it falls short of a target
would add up over the steps of recorded poses, to centimetres within seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import sapien
import torch
from mani_skill.agents.controllers import PDEEPoseController, PDEEPoseControllerConfig
from mani_skill.agents.controllers.utils.kinematics import Kinematics
from mani_skill.utils.geometry.rotation_conversions import matrix_to_quaternion, quaternion_invert, quaternion_multiply
from mani_skill.utils.structs import Link, Pose

from robocas_ms3.arrays import as_tensor, choose, clamp, every, join, length, native, none
from robocas_ms3.robots import rotations
from robocas_ms3.robots.drives import ARM_SET_FROM_OUTSIDE, EvenDrives
from robocas_ms3.robots.ee_deltas import ee_delta_target

BODY_FRAME = "body_translation:body_aligned_body_rotation"
BATCHED_IK_ITERATIONS, IK_DAMPING = 8, 1e-4
FARTHEST = 0.5  # m and rad together that one iteration goes: linear steps lead astray beyond
IK_TOLERANCE = 1e-4  # m and rad together, as SAPIEN's solver has it, which is used on a CPU
# m and rad between the TCP and the pose it was asked for: beyond, something holds the arm back, or set it elsewhere.
EE_HELD_BACK = (0.1, 0.5)


def relative_pose(frame: Link, link: Link) -> Pose:
    """(N,) poses of a link in the frame of another; on a CPU by SAPIEN, ten times faster than by tensors."""
    return Pose(raw_pose=as_tensor(_relative_pose(frame, link)))


def _relative_pose(frame: Link, link: Link) -> Any:
    """(N, 7) native (`arrays`) poses of a link in the frame of another."""
    if frame.scene.gpu_sim_enabled:
        return (frame.pose.inv() * link.pose).raw_pose
    pose = frame._bodies[0].entity_pose.inv() * link._bodies[0].entity_pose
    position, quaternion = pose.p, pose.q
    if quaternion[0] < 0:  # as ManiSkill's products
        quaternion = -quaternion
    return np.concatenate([position, quaternion])[None]


def batched_ik(
    kinematics: Kinematics, target: Pose, qpos: torch.Tensor, limits: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Solve inverse kinematics of many arms at once, within their joints' limits.

    Levenberg's damped steps; a joint that a step would push beyond its limit takes no part in it. ManiSkill's batched
    solver takes one step, too coarse for 0.5 rad, and knows no limits.

    Args:
        kinematics: set up for batches, as it is on a GPU.
        target: (N,) poses of the end link in the root frame of the kinematics.
        qpos: (N, joints) present configuration.
        limits: (joints, 2), rad.

    Returns:
        (N, joints) positions, and (N,) whether they reach the poses, to ``IK_TOLERANCE``.
    """
    low, high = limits.unbind(1)
    damping = IK_DAMPING * torch.eye(len(limits), device=qpos.device)
    missed = _missed(kinematics, target, qpos)
    for _ in range(BATCHED_IK_ITERATIONS):
        jacobian = cast("torch.Tensor", kinematics.pk_chain.jacobian(qpos))
        missed = missed * (FARTHEST / torch.linalg.vector_norm(missed, dim=1, keepdim=True)).clamp(max=1.0)
        downhill = (jacobian.mT @ missed[..., None])[..., 0]
        stuck = ((qpos <= low) & (downhill < 0)) | ((qpos >= high) & (downhill > 0))
        jacobian = jacobian.masked_fill(stuck[:, None], 0.0)
        step = torch.linalg.solve(jacobian.mT @ jacobian + damping, jacobian.mT @ missed[..., None])
        qpos = (qpos + step[..., 0]).clamp(low, high)
        missed = _missed(kinematics, target, qpos)
    return qpos, torch.linalg.vector_norm(missed, dim=1) < IK_TOLERANCE


def _missed(kinematics: Kinematics, target: Pose, qpos: torch.Tensor) -> torch.Tensor:
    """(N, 6) translation, m, and rotation, about rad, from the end link to where it should be, in the root frame."""
    reached = cast("Any", kinematics.pk_chain.forward_kinematics(qpos)).get_matrix()
    turned = quaternion_multiply(target.q, quaternion_invert(matrix_to_quaternion(reached[:, :3, :3])))
    return torch.cat([target.p - reached[:, :3, 3], 2 * turned[:, 1:] * turned[:, :1].sign()], dim=1)


class RoboCASEEPoseController(EvenDrives, PDEEPoseController):
    """End-effector pose control: deltas in the end effector's frame, or absolute poses in the arm's base frame.

    Differs from ManiSkill's: rotations have their natural sign; body-frame deltas work on a GPU too, since the target
    pose in the base frame is computed before inverse kinematics; and a target that the arm does not come near to is
    given up, so that deltas don't pile up while something is in the way. Within a control step the drive target of
    deltas moves evenly, with its velocity, so that the TCP goes evenly from pose to pose, as it did when these poses
    were recorded, and is there when the step ends.
    """

    def _check_gpu_sim_works(self) -> None:
        """Every frame works: ``set_action`` hands poses in the root frame to inverse kinematics."""

    def _clip_and_scale_action(self, action: Any) -> Any:
        position = self._middle[:3] + self._half[:3] * clamp(action[:, :3], -1, 1)
        rotation, most = action[:, 3:], native(self.action_space_high)[3:]
        size = native(torch.linalg.vector_norm(as_tensor(rotation), dim=1, keepdim=True).clamp(min=1.0))
        return join([position, rotation / size * most])

    def _wanted_pose(self, reference: Any, action: Any) -> Any:
        """(N, 7) the target in the arm's base frame, native.

        Args:
            reference: (N, 7) the pose that deltas refer to; None where actions are poses.
            action: (N, 6) scaled: m and rad.
        """
        if reference is not None:
            return join([*ee_delta_target(reference[:, :3], reference[:, 3:], action)])
        return join([action[:, :3], rotations.from_euler(action[:, 3:6])])

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        self._limits = self.articulation.get_qlimits()[0, self.active_joint_indices]
        if not self.kinematics.use_gpu_ik:
            of_model: list[torch.Tensor] = [
                self.kinematics.pmodel_active_joint_indices,
                self.kinematics.qmask,
                self.kinematics.pmodel_controlled_joint_indices,
            ]
            self._chain, self._free, self._arm = (tensor.numpy() for tensor in of_model)

    sets_target_qvel = True

    def set_action(self, action: Any) -> None:
        """Drive the arm towards the pose; where no inverse kinematics is found it stays where it is."""
        action = self._taken(action)
        reference = self._reference_pose() if self.config.use_delta else None
        last = now = self._now()
        if self._target_qpos is not None:
            last = native(self._target_qpos)
        start = choose(abs(last - now) > ARM_SET_FROM_OUTSIDE, now, last)
        wanted = self._wanted_pose(reference, action)
        target, solved = self._solve(wanted)
        if not every(solved):
            stay = self._reference_pose() if reference is None else reference
            target, wanted = choose(solved[:, None], target, now), choose(solved[:, None], wanted, stay)
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
        """`reference_pose`, (N, 7) native."""
        if not self.config.use_target or self._target_pose is None:
            return native(self.ee_pose_at_base.raw_pose)
        far, turned = EE_HELD_BACK
        now = _relative_pose(cast("Link", self.root_link), self.ee_link)
        target = native(self._target_pose.raw_pose)
        distance = length(target[:, :3] - now[:, :3])
        cosine = abs((target[:, 3:] * now[:, 3:]).sum(1))  # of half the angle between them
        lost = (distance > far) | (cosine < np.cos(turned / 2))
        if none(lost):
            return target
        return choose(lost[:, None], native(self.ee_pose_at_base.raw_pose), target)

    def _solve(self, target: Any) -> tuple[Any, Any]:
        """(N, joints) that reach poses (N, 7) in the arm's base frame, and (N,) whether they do, native."""
        kinematics = self.kinematics
        if self.scene.gpu_sim_enabled:
            return batched_ik(kinematics, Pose(raw_pose=target), self.qpos, self._limits)
        # what ManiSkill's `compute_ik` does, without its conversions
        found, success, _ = kinematics.pmodel.compute_inverse_kinematics(
            kinematics.end_link_idx,
            sapien.Pose(target[0, :3], target[0, 3:]),
            initial_qpos=self.articulation._objs[0].qpos[self._chain],
            active_qmask=self._free,
            max_iterations=100,
        )
        return found[self._arm].astype(np.float32)[None], np.array([success])


@dataclass
class RoboCASEEPoseControllerConfig(PDEEPoseControllerConfig):
    """Configuration of a ``RoboCASEEPoseController``. Rotation bounds must be symmetric."""

    controller_cls = RoboCASEEPoseController
