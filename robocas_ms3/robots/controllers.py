"""Controllers of the mobile Panda: a base that is held, end-effector deltas in the end effector's own frame.

Actions of ``pd_ee_delta_pose``: (x, y, z, rx, ry, rz) in [-1, 1], all in the current TCP frame. Translation is
metres / 0.1. Rotation is Euler angles in radians / 0.5, in the convention of ManiSkill's controllers (intrinsic XYZ:
R = Rx Ry Rz), its norm clipped to 1. A positive angle turns positively about the TCP's axis (ManiSkill's own controller
turns the other way). They start from the pose that the last action asked for, not from where the arm is: what it falls
short of a target would add up over the steps of recorded poses, to centimetres within seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from mani_skill.agents.controllers import (
    PDEEPoseController,
    PDEEPoseControllerConfig,
    PDJointPosController,
    PDJointPosControllerConfig,
    PDJointPosMimicController,
    PDJointPosMimicControllerConfig,
)
from mani_skill.agents.controllers.utils.kinematics import Kinematics
from mani_skill.utils import gym_utils
from mani_skill.utils.geometry.rotation_conversions import (
    euler_angles_to_matrix,
    matrix_to_quaternion,
    quaternion_apply,
    quaternion_multiply,
)
from mani_skill.utils.structs import Link, Pose
from sapien.physx import PhysxArticulationJoint
from scipy.spatial.transform import Rotation

POSITION_SCALE, ROTATION_SCALE = 0.1, 0.5  # m and rad at |action| = 1, end effector
JOINT_SCALE = 0.1  # rad, arm joints
BASE_SCALE = (0.025, 0.025, 0.025)  # m, m, rad, base joints: 0.5 m/s at 20 Hz
BODY_FRAME = "body_translation:body_aligned_body_rotation"
BATCHED_IK_ITERATIONS = 5
# Distances of a joint from its drive target (rad, m) that no motion explains: the state was set from outside.
ARM_SET_FROM_OUTSIDE, HELD_SET_FROM_OUTSIDE = 0.3, 0.02
# m and rad between the TCP and the pose it was asked for: beyond, something holds the arm back, or set it elsewhere.
EE_HELD_BACK = (0.1, 0.5)


def to_ee_delta_action(
    translation: np.ndarray, rotation: np.ndarray | Rotation, *, euler: str | None = None
) -> np.ndarray:
    """Turn a relative motion of the TCP, in its own frame, into the arm's part of a ``pd_ee_delta_pose`` action.

    Args:
        translation: (..., 3) m.
        rotation: (..., 3) rotation vectors, rad; or Euler angles with ``euler``; or a scipy ``Rotation``.
        euler: scipy's name of the convention when ``rotation`` holds Euler angles: ``"XYZ"`` intrinsic (ManiSkill's),
            ``"xyz"`` extrinsic (RoboCAS datasets read with scipy).

    Returns:
        (..., 6) float32, not clipped: beyond +-1 the motion does not fit into one step.
    """
    translation = np.asarray(translation, dtype=np.float64)
    if not isinstance(rotation, Rotation):
        angles = np.asarray(rotation, dtype=np.float64).reshape(-1, 3)
        rotation = Rotation.from_rotvec(angles) if euler is None else Rotation.from_euler(euler, angles)
    angles = rotation.as_euler("XYZ").reshape(translation.shape)
    return np.concatenate([translation / POSITION_SCALE, angles / ROTATION_SCALE], axis=-1).astype(np.float32)


def ee_delta_target(
    position: torch.Tensor, quaternion: torch.Tensor, delta: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Apply a motion given in the end effector's frame to its pose in any parent frame.

    Args:
        position: (N, 3) m, of the end effector in the parent frame.
        quaternion: (N, 4) wxyz.
        delta: (N, 6) translation in m and intrinsic XYZ Euler angles in rad, in the end effector's frame.

    Returns:
        Position (N, 3) and quaternion (N, 4) of the target in the parent frame.
    """
    rotation = matrix_to_quaternion(euler_angles_to_matrix(delta[:, 3:6], "XYZ"))
    return position + quaternion_apply(quaternion, delta[:, :3]), quaternion_multiply(quaternion, rotation)


def relative_pose(frame: Link, link: Link) -> Pose:
    """(N,) poses of a link in the frame of another; on a CPU by SAPIEN, ten times faster than by tensors."""
    if frame.scene.gpu_sim_enabled:
        return frame.pose.inv() * link.pose
    pose = frame._bodies[0].entity_pose.inv() * link._bodies[0].entity_pose
    position, quaternion = pose.p, pose.q
    if quaternion[0] < 0:  # as ManiSkill's products
        quaternion = -quaternion
    return Pose(raw_pose=torch.from_numpy(np.concatenate([position, quaternion]))[None])


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


class DirectDrives(PDJointPosController):
    """Sets drive targets, on a CPU without ManiSkill's wrapper of each joint, which takes longer than the physics."""

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        self._drives: list[PhysxArticulationJoint] = [joint._objs[0] for joint in self.joints]

    def set_drive_targets(self, targets: torch.Tensor) -> None:
        """Set the targets (N, joints), rad or m, of all joints."""
        if self.scene.gpu_sim_enabled:
            super().set_drive_targets(targets)
            return
        for drive, target in zip(self._drives, targets[0].tolist(), strict=True):
            drive.set_drive_target(target)

    def set_drive_velocities(self, velocities: torch.Tensor) -> None:
        """Set the velocities (N, joints), rad/s or m/s, that the drives of all joints aim at."""
        if self.scene.gpu_sim_enabled:
            self.articulation.set_joint_drive_velocity_targets(velocities, self.joints, self.active_joint_indices)
            return
        for drive, velocity in zip(self._drives, velocities[0].tolist(), strict=True):
            drive.set_drive_velocity_target(velocity)


class FingersController(DirectDrives, PDJointPosMimicController):
    """Absolute positions of fingers that all do the same; ManiSkill's, without its detours."""

    def set_action(self, action: Any) -> None:
        """Take the position (N, 1) of every finger."""
        targets = cast("torch.Tensor", self._preprocess_action(action)).repeat(1, len(self.joints))
        self._target_qpos = targets
        self.set_drive_targets(targets)


@dataclass
class FingersControllerConfig(PDJointPosMimicControllerConfig):
    """Configuration of a ``FingersController``: what mimics does so one to one."""

    controller_cls = FingersController


class SmoothJointPosController(DirectDrives):
    """Joint positions, absolute or relative to the last target, whose drive target moves evenly within a control step.

    A target that jumps at 5 Hz makes the arm start and stop with every step, at twice the planned velocity. ManiSkill's
    ``interpolate`` starts from where the arm is instead of from the last target, and jerks more than jumps do.
    """

    config: SmoothJointPosControllerConfig

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        self._limits = self.articulation.get_qlimits()[0, self.active_joint_indices]

    def set_action(self, action: Any) -> None:
        """Take the positions (N, joints), rad or m, to command at the end of the control step."""
        action = self._preprocess_action(action)
        assert self._target_qpos is not None, "the controller has not been reset"
        now = self.qpos
        start = torch.where((self._target_qpos - now).abs() > ARM_SET_FROM_OUTSIDE, now, self._target_qpos)
        travel = action if self.config.use_delta else action - start
        if self.config.max_speed is not None:
            furthest = self.config.max_speed / self._control_freq
            travel = travel.clamp(-furthest, furthest)
        self._step = 0
        self._start_qpos = start
        self._target_qpos = torch.clamp(start + travel, self._limits[:, 0], self._limits[:, 1])

    def before_simulation_step(self) -> None:
        """Move the drive target on."""
        if self._start_qpos is None or self._target_qpos is None or self._step >= self._sim_steps:
            return
        self._step += 1
        self.set_drive_targets(torch.lerp(self._start_qpos, self._target_qpos, self._step / self._sim_steps))
        if self.scene.gpu_sim_enabled:
            cast("Any", self.scene.px).gpu_apply_articulation_target_position()

    def reset(self) -> None:
        """Start from the present configuration."""
        super().reset()
        self._step = self._sim_steps


@dataclass
class SmoothJointPosControllerConfig(PDJointPosControllerConfig):
    """Configuration of a ``SmoothJointPosController``."""

    normalize_action: bool = False
    max_speed: float | None = None
    """rad/s or m/s that the target moves at most; a command further away takes several steps."""
    controller_cls = SmoothJointPosController


class HeldJointsController(DirectDrives):
    """Holds joints where they are at reset; takes no action (0 dimensions)."""

    def _initialize_action_space(self) -> None:
        self.single_action_space = spaces.Box(np.empty(0, np.float32), np.empty(0, np.float32))

    def reset(self) -> None:
        """Take the present configuration as the one to hold."""
        super().reset()
        self.set_drive_targets(self._target_qpos)

    def set_action(self, action: Any) -> None:
        """Keep the drive targets, unless the state was set from outside: then hold the joints where they are now."""
        assert self._target_qpos is not None, "the controller has not been reset"
        now = self.qpos
        moved = (self._target_qpos - now).abs() > HELD_SET_FROM_OUTSIDE
        self._target_qpos = torch.where(moved, now, self._target_qpos)
        self.set_drive_targets(self._target_qpos)


@dataclass
class HeldJointsControllerConfig(PDJointPosControllerConfig):
    """Configuration of a ``HeldJointsController``; bounds are not used."""

    lower: None = None
    upper: None = None
    stiffness: Any = None
    damping: Any = None
    normalize_action: bool = False
    controller_cls = HeldJointsController


class RoboCASEEPoseController(DirectDrives, PDEEPoseController):
    """End-effector pose control: deltas in the end effector's frame, or absolute poses in the arm's base frame.

    Differs from ManiSkill's: rotations have their natural sign; body-frame deltas work on a GPU too, since the target
    pose in the base frame is computed before inverse kinematics; and a target that the arm does not come near to is
    given up, so that deltas don't pile up while something is in the way. Within a control step the drive target of
    deltas moves evenly, with its velocity, so that the TCP goes evenly from pose to pose, as it did when these poses
    were recorded, and is there when the step ends.
    """

    def _check_gpu_sim_works(self) -> None:
        """Every frame works: ``set_action`` hands poses in the root frame to inverse kinematics."""

    def _clip_and_scale_action(self, action: torch.Tensor) -> torch.Tensor:
        position = gym_utils.clip_and_scale_action(action[:, :3], self.action_space_low[:3], self.action_space_high[:3])
        rotation = action[:, 3:]
        rotation = rotation / torch.linalg.norm(rotation, dim=1, keepdim=True).clamp(min=1.0)
        return torch.hstack([position, rotation * self.action_space_high[3:]])

    def compute_target_pose(self, prev_ee_pose_at_base: Pose | None, action: torch.Tensor) -> Pose:
        """Compute the target in the arm's base frame.

        Args:
            prev_ee_pose_at_base: (N,) the pose that deltas refer to; None where actions are poses.
            action: (N, 6) scaled: m and rad.
        """
        if prev_ee_pose_at_base is not None:
            return Pose.create_from_pq(*ee_delta_target(prev_ee_pose_at_base.p, prev_ee_pose_at_base.q, action))
        rotation = matrix_to_quaternion(euler_angles_to_matrix(action[:, 3:6], "XYZ"))
        return Pose.create_from_pq(action[:, :3], rotation)

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
        action = self._preprocess_action(action)
        self._step = 0
        reference = self.reference_pose() if self.config.use_delta else None
        last = now = self.qpos
        if self._target_qpos is not None:
            last = self._target_qpos
        moved = (last - now).abs() > ARM_SET_FROM_OUTSIDE
        if self._forgotten is not None:
            moved |= self._forgotten[:, None]
        self._start_qpos = torch.where(moved, now, last)
        wanted = self.compute_target_pose(reference, action)
        target = self._solve(wanted)
        if target is None:
            target, wanted = now, self.reference_pose() if reference is None else reference
        self._target_pose = wanted
        self._target_qpos, self._forgotten = target, None
        if self.config.use_delta:
            self._drive_with(self._start_qpos, (target - self._start_qpos) * self._control_freq)
        else:
            self._drive_with(target, torch.zeros_like(target))

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

    def before_simulation_step(self) -> None:
        """Move the drive target of deltas on."""
        if not self.config.use_delta or self._step >= self._sim_steps or self._target_qpos is None:
            return
        self._step += 1
        self.set_drive_targets(torch.lerp(self._start_qpos, self._target_qpos, self._step / self._sim_steps))
        if self.scene.gpu_sim_enabled:
            cast("Any", self.scene.px).gpu_apply_articulation_target_position()

    def _drive_with(self, targets: torch.Tensor, velocities: torch.Tensor) -> None:
        """Set drive targets and their velocities: an arm that is told its velocity does not lag."""
        self.set_drive_targets(targets)
        self.set_drive_velocities(velocities)

    def reset(self) -> None:
        """Start from the present configuration, at rest."""
        super().reset()
        self._step = self._sim_steps

    def reference_pose(self) -> Pose:
        """(N,) poses in the arm's base frame that the next deltas start from."""
        if not self.config.use_target or self._target_pose is None:
            return self.ee_pose_at_base
        far, turned = EE_HELD_BACK
        now = relative_pose(cast("Link", self.root_link), self.ee_link)
        distance = torch.linalg.vector_norm(self._target_pose.p - now.p, dim=1)
        cosine = (self._target_pose.q * now.q).sum(dim=1).abs()  # of half the angle between them
        lost = (distance > far) | (cosine < np.cos(turned / 2))
        if self._forgotten is not None:
            lost |= self._forgotten
        if not lost.any():
            return self._target_pose
        return Pose.create(torch.where(lost[:, None], self.ee_pose_at_base.raw_pose, self._target_pose.raw_pose))

    def _solve(self, target: Pose) -> torch.Tensor | None:
        """(N, joints) that reach poses in the arm's base frame; None: not found, on a CPU."""
        kinematics, qpos = self.kinematics, self.articulation.get_qpos()
        if self.scene.gpu_sim_enabled:
            return batched_ik(kinematics, target, qpos, self.active_joint_indices, self.ee_pose_at_base)
        # what ManiSkill's `compute_ik` does, without its conversions
        found, success, _ = kinematics.pmodel.compute_inverse_kinematics(
            kinematics.end_link_idx,
            target.sp,
            initial_qpos=qpos[0].numpy()[self._chain],
            active_qmask=self._free,
            max_iterations=100,
        )
        return torch.from_numpy(found[self._arm].astype(np.float32))[None] if success else None


@dataclass
class RoboCASEEPoseControllerConfig(PDEEPoseControllerConfig):
    """Configuration of a ``RoboCASEEPoseController``. Rotation bounds must be symmetric."""

    controller_cls = RoboCASEEPoseController
