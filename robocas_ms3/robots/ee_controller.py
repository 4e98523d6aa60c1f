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
from mani_skill.utils.structs import Link, Pose

from robocas_ms3.arrays import as_tensor, choose, clamp, join, length, native
from robocas_ms3.robots import rotations
from robocas_ms3.robots.drives import ARM_SET_FROM_OUTSIDE, EvenDrives
from robocas_ms3.robots.ee_deltas import ee_delta_target

BODY_FRAME = "body_translation:body_aligned_body_rotation"
BATCHED_IK_ITERATIONS = 5
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
    kinematics: Kinematics, target: Pose, qpos: torch.Tensor, joints: torch.Tensor, now: Pose
) -> torch.Tensor:
    """Solve inverse kinematics of many arms at once with ManiSkill's batched solver.

    That solver takes one linear step, too coarse for 0.5 rad, so it is repeated.

    Args:
        kinematics: set up for batches, as it is on a GPU.
        target: (N,) poses of the end link in the root frame of the kinematics.
        qpos: (N, dof) present configuration of the whole articulation.
        joints: indices in ``qpos`` of the joints to solve for.
        now: (N,) present poses of the end link.

    Returns:
        (N, joints) positions.
    """
    qpos = qpos.clone()
    current: Pose | None = now
    for _ in range(BATCHED_IK_ITERATIONS):
        config = dict(type="levenberg_marquardt", alpha=1.0)
        solved = kinematics.compute_ik(pose=target, q0=qpos, current_pose=current, solver_config=config)
        qpos[:, joints] = cast("torch.Tensor", solved)
        current = None
    return qpos[:, joints]


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
        if not self.kinematics.use_gpu_ik:
            of_model: list[torch.Tensor] = [
                self.kinematics.pmodel_active_joint_indices,
                self.kinematics.qmask,
                self.kinematics.pmodel_controlled_joint_indices,
            ]
            self._chain, self._free, self._arm = (tensor.numpy() for tensor in of_model)

    sets_target_qvel = True
    _forgotten: torch.Tensor | None = None  # (N,) whose targets count no longer

    def set_action(self, action: Any) -> None:
        """Drive the arm towards the pose; where no inverse kinematics is found it stays where it is."""
        action = self._taken(action)
        reference = self._reference_pose() if self.config.use_delta else None
        last = now = self._now()
        if self._target_qpos is not None:
            last = native(self._target_qpos)
        moved = abs(last - now) > ARM_SET_FROM_OUTSIDE
        if self._forgotten is not None:
            moved |= native(self._forgotten)[:, None]
        start, wanted = choose(moved, now, last), self._wanted_pose(reference, action)
        target = self._solve(wanted)
        if target is None:
            target, wanted = now, self._reference_pose() if reference is None else reference
        self._target_pose = Pose(raw_pose=as_tensor(wanted))
        self._target_qpos, self._forgotten = as_tensor(target), None
        if self.config.use_delta:
            self._drive_with(start, (target - start) * self._control_freq)
            self._move_evenly(start, target)
        else:
            self._drive_with(target, torch.zeros_like(as_tensor(target)))

    def forget_targets(self, env_idx: torch.Tensor | None = None) -> None:
        """Let the next action start from where the arm is: its state was set from outside.

        Args:
            env_idx: of the envs; default: all.
        """
        forgotten = torch.zeros(len(self.qpos), dtype=torch.bool, device=self.device)
        if self._forgotten is not None:
            forgotten |= self._forgotten
        forgotten[slice(None) if env_idx is None else env_idx] = True
        self._forgotten = forgotten

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
        if self._forgotten is not None:
            lost |= native(self._forgotten)
        if not lost.any():
            return target
        return choose(lost[:, None], native(self.ee_pose_at_base.raw_pose), target)

    def _solve(self, target: Any) -> Any:
        """(N, joints) that reach poses (N, 7) in the arm's base frame, native; None: not found, on a CPU."""
        kinematics = self.kinematics
        if self.scene.gpu_sim_enabled:
            qpos, pose = self.articulation.get_qpos(), Pose(raw_pose=target)
            return batched_ik(kinematics, pose, qpos, self.active_joint_indices, self.ee_pose_at_base)
        # what ManiSkill's `compute_ik` does, without its conversions
        found, success, _ = kinematics.pmodel.compute_inverse_kinematics(
            kinematics.end_link_idx,
            sapien.Pose(target[0, :3], target[0, 3:]),
            initial_qpos=self.articulation._objs[0].qpos[self._chain],
            active_qmask=self._free,
            max_iterations=100,
        )
        return found[self._arm].astype(np.float32)[None] if success else None


@dataclass
class RoboCASEEPoseControllerConfig(PDEEPoseControllerConfig):
    """Configuration of a ``RoboCASEEPoseController``. Rotation bounds must be symmetric."""

    controller_cls = RoboCASEEPoseController
