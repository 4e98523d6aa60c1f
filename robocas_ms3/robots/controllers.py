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
import sapien
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
from mani_skill.utils.structs import Link, Pose
from sapien.physx import PhysxArticulationJoint
from scipy.spatial.transform import Rotation

from robocas_ms3.arrays import Array, as_tensor, choose, clamp, join, length, native
from robocas_ms3.robots import rotations

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


def ee_delta_target(position: Array, quaternion: Array, delta: Array) -> tuple[Array, Array]:
    """Apply a motion given in the end effector's frame to its pose in any parent frame.

    Args:
        position: (N, 3) m, of the end effector in the parent frame.
        quaternion: (N, 4) wxyz.
        delta: (N, 6) translation in m and intrinsic XYZ Euler angles in rad, in the end effector's frame.

    Returns:
        Position (N, 3) and quaternion (N, 4) of the target in the parent frame.
    """
    rotation = rotations.from_euler(delta[:, 3:6])
    return position + rotations.turn(quaternion, delta[:, :3]), rotations.multiply(quaternion, rotation)


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


class DirectDrives(PDJointPosController):
    """Works on native arrays (`arrays`), and on a CPU without ManiSkill's wrapper of each joint.

    These would take longer than the physics.
    """

    action_space_low: Any
    action_space_high: Any

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        self._drives: list[PhysxArticulationJoint] = [joint._objs[0] for joint in self.joints]
        self._columns = native(self.active_joint_indices)

    def _clip_and_scale_action_space(self) -> None:
        super()._clip_and_scale_action_space()
        low, high = native(self.action_space_low), native(self.action_space_high)
        self._middle, self._half = 0.5 * (high + low), 0.5 * (high - low)

    def _clip_and_scale_action(self, action: Any) -> Any:
        return self._middle + self._half * clamp(action, -1, 1)

    def _taken(self, action: Any) -> Any:
        """An action (N, size) tensor, native and scaled."""
        return self._preprocess_action(native(action))

    def _now(self) -> Any:
        """(N, joints) present positions, rad or m, native."""
        if self.scene.gpu_sim_enabled:
            return self.qpos
        return self.articulation._objs[0].qpos[None, self._columns]

    def set_drive_targets(self, targets: torch.Tensor) -> None:
        """Set the targets (N, joints), rad or m, of all joints."""
        if self.scene.gpu_sim_enabled:
            super().set_drive_targets(targets)
        else:
            self._drive_to(targets[0].tolist())

    def _drive_to(self, targets: list[float]) -> None:
        """`set_drive_targets` on a CPU."""
        for drive, target in zip(self._drives, targets, strict=True):
            drive.set_drive_target(target)

    def set_drive_velocities(self, velocities: torch.Tensor) -> None:
        """Set the velocities (N, joints), rad/s or m/s, that the drives of all joints aim at."""
        if self.scene.gpu_sim_enabled:
            self.articulation.set_joint_drive_velocity_targets(velocities, self.joints, self.active_joint_indices)
            return
        for drive, velocity in zip(self._drives, velocities[0].tolist(), strict=True):
            drive.set_drive_velocity_target(velocity)


class EvenDrives(DirectDrives):
    """Moves the drive targets evenly from one to the next within a control step."""

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        shares = torch.arange(1, self._sim_steps + 1, device=self.device) / self._sim_steps
        self._shares = shares[:, None, None]
        self._ahead: list[Any] = []

    def _move_evenly(self, start: Any, end: Any) -> None:
        """Plan the control step's drive targets, from after ``start`` (N, joints) to ``end``, native."""
        targets = torch.lerp(as_tensor(start), as_tensor(end), self._shares)  # (steps, N, joints)
        self._ahead = list(targets) if self.scene.gpu_sim_enabled else targets[:, 0].tolist()
        self._step = 0

    def before_simulation_step(self) -> None:
        """Move the drive targets on."""
        if self._step >= len(self._ahead):
            return
        targets = self._ahead[self._step]
        self._step += 1
        if self.scene.gpu_sim_enabled:
            self.set_drive_targets(targets)
            cast("Any", self.scene.px).gpu_apply_articulation_target_position()
        else:
            self._drive_to(targets)

    def reset(self) -> None:
        """Start from the present configuration."""
        super().reset()
        self._ahead = []


class FingersController(DirectDrives, PDJointPosMimicController):
    """Absolute positions of fingers that all do the same; ManiSkill's, without its detours."""

    def set_action(self, action: Any) -> None:
        """Take the position (N, 1) of every finger."""
        action = self._taken(action)
        self._target_qpos = as_tensor(join([action] * len(self.joints)))
        self.set_drive_targets(self._target_qpos)


@dataclass
class FingersControllerConfig(PDJointPosMimicControllerConfig):
    """Configuration of a ``FingersController``: what mimics does so one to one."""

    controller_cls = FingersController


class SmoothJointPosController(EvenDrives):
    """Joint positions, absolute or relative to the last target, whose drive target moves evenly within a control step.

    A target that jumps at 5 Hz makes the arm start and stop with every step, at twice the planned velocity. ManiSkill's
    ``interpolate`` starts from where the arm is instead of from the last target, and jerks more than jumps do.
    """

    config: SmoothJointPosControllerConfig

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        limits = native(self.articulation.get_qlimits()[0, self.active_joint_indices])
        self._low, self._high = limits[:, 0], limits[:, 1]

    def set_action(self, action: Any) -> None:
        """Take the positions (N, joints), rad or m, to command at the end of the control step."""
        action = self._taken(action)
        assert self._target_qpos is not None, "the controller has not been reset"
        now, last = self._now(), native(self._target_qpos)
        start = choose(abs(last - now) > ARM_SET_FROM_OUTSIDE, now, last)
        travel = action if self.config.use_delta else action - start
        if self.config.max_speed is not None:
            furthest = self.config.max_speed / self._control_freq
            travel = clamp(travel, -furthest, furthest)
        target = clamp(start + travel, self._low, self._high)
        self._target_qpos = as_tensor(target)
        self._move_evenly(start, target)


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
        now, held = self._now(), native(self._target_qpos)
        self._target_qpos = as_tensor(choose(abs(held - now) > HELD_SET_FROM_OUTSIDE, now, held))
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
