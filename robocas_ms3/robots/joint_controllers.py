"""Joint controllers: interpolated arm joints, mimicking fingers, a held base, and the combined robot controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from mani_skill.agents.controllers import (
    PDJointPosControllerConfig,
    PDJointPosMimicController,
    PDJointPosMimicControllerConfig,
)
from mani_skill.agents.controllers.base_controller import CombinedController
from mani_skill.utils.structs import Pose

from robocas_ms3.core.arrays import as_tensor, clamp, concatenate, to_native, where
from robocas_ms3.robots.drives import (
    ARM_RESET_DISTANCE,
    BASE_RESET_DISTANCE,
    BatchedDrives,
    DirectDrives,
    InterpolatedDrives,
)

JOINT_SCALE = 0.1  # rad at |action| = 1, arm joints
BASE_SCALE = (0.025, 0.025, 0.025)  # m, m, rad, base joints: 0.5 m/s at 20 Hz


@dataclass
class JointDeltaControllerConfig(PDJointPosControllerConfig):
    """Configuration of a joint delta controller on a GPU, `BatchedDrives`."""

    controller_cls = BatchedDrives


class FingersController(DirectDrives, PDJointPosMimicController):
    """Gripper controller that sends one absolute position to all fingers.

    It is faster than ManiSkill's mimic controller.
    """

    def set_action(self, action: Any) -> None:
        """Set the target position (N, 1) of all fingers."""
        action = self._scale_action(action)
        self._target_qpos = as_tensor(concatenate([action] * len(self.joints)))
        self.set_drive_targets(self._target_qpos)


@dataclass
class FingersControllerConfig(PDJointPosMimicControllerConfig):
    """Configuration of a ``FingersController``. All fingers have the same position (mimic factor 1)."""

    controller_cls = FingersController


class SmoothJointPosController(InterpolatedDrives):
    """Joint position controller that interpolates drive targets.

    Actions are positions, or deltas of the last target.

    Without interpolation, targets at 5 Hz would start and stop the arm in every step at twice the planned velocity.
    ManiSkill's ``interpolate`` starts from the current position instead of the last target, which causes more jerk.
    """

    config: SmoothJointPosControllerConfig

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        limits = to_native(self.articulation.get_qlimits()[0, self.active_joint_indices])
        self._low, self._high = limits[:, 0], limits[:, 1]

    def set_action(self, action: Any) -> None:
        """Set the positions (N, joints) at the end of the control step, in rad or m, or their deltas."""
        action = self._scale_action(action)
        assert self._target_qpos is not None, "the controller has not been reset"
        now, last = self._current_qpos(), to_native(self._target_qpos)
        start = where(abs(last - now) > ARM_RESET_DISTANCE, now, last)
        travel = action if self.config.use_delta else action - start
        if self.config.max_speed is not None:
            max_travel = self.config.max_speed / self._control_freq
            travel = clamp(travel, -max_travel, max_travel)
        target = clamp(start + travel, self._low, self._high)
        self._target_qpos = as_tensor(target)
        self._interpolate(start, target)


@dataclass
class SmoothJointPosControllerConfig(PDJointPosControllerConfig):
    """Configuration of a ``SmoothJointPosController``."""

    normalize_action: bool = False
    max_speed: float | None = None
    """Limit of the target's speed in rad/s or m/s; a more distant command needs several steps."""
    controller_cls = SmoothJointPosController


class HoldJointsController(DirectDrives):
    """Controller without actions that holds joints at the positions that they have after a reset."""

    def _initialize_action_space(self) -> None:
        self.single_action_space = spaces.Box(np.empty(0, np.float32), np.empty(0, np.float32))

    def reset(self) -> None:
        """Hold the current joint positions in the envs that are being reset."""
        super().reset()
        held = self._target_qpos[self.scene._reset_mask]
        if self.scene.gpu_sim_enabled:
            self.articulation.set_joint_drive_targets(held, self.joints, self.active_joint_indices)
        else:
            self.set_drive_targets(held)

    def set_action(self, action: Any) -> None:
        """Keep the drive targets.

        If the simulation state was set since the last step, hold the current positions.
        """
        assert self._target_qpos is not None, "the controller has not been reset"
        now, held = self._current_qpos(), to_native(self._target_qpos)
        self._target_qpos = as_tensor(where(abs(held - now) > BASE_RESET_DISTANCE, now, held))
        self.set_drive_targets(self._target_qpos)


@dataclass
class HoldJointsControllerConfig(PDJointPosControllerConfig):
    """Configuration of a ``HoldJointsController``."""

    lower: None = None
    upper: None = None
    stiffness: Any = None
    damping: Any = None
    normalize_action: bool = False
    controller_cls = HoldJointsController


State = Mapping[str, Mapping[str, Any]]
"""Controller -> ``target_qpos`` (N, joints) in rad or m, ``target_pose`` (N, 7) of the TCP in the arm's base frame."""


class RobotController(CombinedController):
    """Controller of arm, gripper and base, which can reset a subset of the envs.

    ManiSkill clears its reset mask before it resets the controllers, which would reset the controllers of all envs.
    """

    reset_only: torch.Tensor | None = None
    """Indices of the envs of the next reset; None: all."""

    def reset(self) -> None:
        """Set the targets to the current joint positions in the envs that are being reset (`reset_only`)."""
        mask = self.scene._reset_mask
        if self.reset_only is not None:
            self.scene._reset_mask = torch.zeros_like(mask)
            self.scene._reset_mask[self.reset_only] = True
        try:
            super().reset()
        finally:
            self.scene._reset_mask, self.reset_only = mask, None

    def targets(self) -> dict[str, dict[str, torch.Tensor]]:
        """Return a copy of the present targets, to which deltas of the next action are added, as `State`."""
        found: dict[str, dict[str, torch.Tensor]] = {}
        for name, controller in self.controllers.items():
            part, kept = cast("Any", controller), found.setdefault(name, {})
            if part._target_qpos is not None:
                kept["target_qpos"] = part._target_qpos.clone()
            if getattr(part, "_target_pose", None) is not None:
                kept["target_pose"] = part._target_pose.raw_pose.clone()
        return found

    def set_targets(self, state: State | None = None, env_idx: torch.Tensor | None = None) -> None:
        """Set the targets of some envs.

        Args:
            state: result of `targets`; a target that it does not have is set to the current position.
            env_idx: indices (E,) of the envs; None: all.
        """
        envs = slice(None) if env_idx is None else env_idx
        for name, controller in self.controllers.items():
            part, given = cast("Any", controller), (state or {}).get(name, {})
            if part._target_qpos is not None:
                target = given.get("target_qpos", part.qpos[envs])
                part._target_qpos = _set_rows(part._target_qpos, envs, target)
            if getattr(part, "_target_pose", None) is not None:
                target = given["target_pose"] if "target_pose" in given else part.ee_pose_at_base.raw_pose[envs]
                part._target_pose = Pose(raw_pose=_set_rows(part._target_pose.raw_pose, envs, target))


def _set_rows(values: torch.Tensor, envs: Any, rows: Any) -> torch.Tensor:
    values = values.clone()
    values[envs] = torch.as_tensor(rows, dtype=values.dtype, device=values.device).reshape(-1, values.shape[1])
    return values
