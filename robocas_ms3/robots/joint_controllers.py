"""Controllers of joints: the arm's, moved evenly; fingers that do the same; a base that is held; all of a robot."""

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
    """Configuration of ManiSkill's joint deltas on a GPU; see ``BatchedDrives``."""

    controller_cls = BatchedDrives


class FingersController(DirectDrives, PDJointPosMimicController):
    """Absolute positions of fingers that all do the same; ManiSkill's, without its detours."""

    def set_action(self, action: Any) -> None:
        """Take the position (N, 1) of every finger."""
        action = self._taken(action)
        self._target_qpos = as_tensor(concatenate([action] * len(self.joints)))
        self.set_drive_targets(self._target_qpos)


@dataclass
class FingersControllerConfig(PDJointPosMimicControllerConfig):
    """Configuration of a ``FingersController``: what mimics does so one to one."""

    controller_cls = FingersController


class SmoothJointPosController(InterpolatedDrives):
    """Joint positions, absolute or relative to the last target, whose drive target moves evenly within a control step.

    A target that jumps at 5 Hz makes the arm start and stop with every step, at twice the planned velocity. ManiSkill's
    ``interpolate`` starts from where the arm is instead of from the last target, and jerks more than jumps do.
    """

    config: SmoothJointPosControllerConfig

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        limits = to_native(self.articulation.get_qlimits()[0, self.active_joint_indices])
        self._low, self._high = limits[:, 0], limits[:, 1]

    def set_action(self, action: Any) -> None:
        """Take the positions (N, joints), rad or m, to command at the end of the control step."""
        action = self._taken(action)
        assert self._target_qpos is not None, "the controller has not been reset"
        now, last = self._now(), to_native(self._target_qpos)
        start = where(abs(last - now) > ARM_RESET_DISTANCE, now, last)
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
        """Take the present configuration as the one to hold, in the envs that are being reset."""
        super().reset()
        held = self._target_qpos[self.scene._reset_mask]
        if self.scene.gpu_sim_enabled:
            self.articulation.set_joint_drive_targets(held, self.joints, self.active_joint_indices)
        else:
            self.set_drive_targets(held)

    def set_action(self, action: Any) -> None:
        """Keep the drive targets, unless the state was set from outside: then hold the joints where they are now."""
        assert self._target_qpos is not None, "the controller has not been reset"
        now, held = self._now(), to_native(self._target_qpos)
        self._target_qpos = as_tensor(where(abs(held - now) > BASE_RESET_DISTANCE, now, held))
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


State = Mapping[str, Mapping[str, Any]]
"""By controller: ``target_qpos`` (N, joints), rad or m; ``target_pose`` (N, 7) of the TCP in the arm's base frame."""


class RobotController(CombinedController):
    """ManiSkill's, whose reset leaves the other envs alone.

    ManiSkill resets controllers after it has forgotten which envs are reset: all would start from where they are.
    """

    reset_only: torch.Tensor | None = None
    """Indices of the envs of the next reset; None: all."""

    def reset(self) -> None:
        """Start from where the joints are, in the envs that are being reset."""
        every = self.scene._reset_mask
        if self.reset_only is not None:
            self.scene._reset_mask = torch.zeros_like(every)
            self.scene._reset_mask[self.reset_only] = True
        try:
            super().reset()
        finally:
            self.scene._reset_mask, self.reset_only = every, None

    def targets(self) -> dict[str, dict[str, torch.Tensor]]:
        """Return a copy of what the next actions start from besides the joints, as `State`."""
        found: dict[str, dict[str, torch.Tensor]] = {}
        for name, controller in self.controllers.items():
            part, kept = cast("Any", controller), found.setdefault(name, {})
            if part._target_qpos is not None:
                kept["target_qpos"] = part._target_qpos.clone()
            if getattr(part, "_target_pose", None) is not None:
                kept["target_pose"] = part._target_pose.raw_pose.clone()
        return found

    def set_targets(self, state: State | None = None, env_idx: torch.Tensor | None = None) -> None:
        """Let the next actions of envs start from targets (`targets`), and without these from where the joints are."""
        envs = slice(None) if env_idx is None else env_idx
        for name, controller in self.controllers.items():
            part, given = cast("Any", controller), (state or {}).get(name, {})
            if part._target_qpos is not None:
                target = given.get("target_qpos", part.qpos[envs])
                part._target_qpos = _put(part._target_qpos, envs, target)
            if getattr(part, "_target_pose", None) is not None:
                target = given["target_pose"] if "target_pose" in given else part.ee_pose_at_base.raw_pose[envs]
                part._target_pose = Pose(raw_pose=_put(part._target_pose.raw_pose, envs, target))


def _put(values: torch.Tensor, envs: Any, rows: Any) -> torch.Tensor:
    values = values.clone()
    values[envs] = torch.as_tensor(rows, dtype=values.dtype, device=values.device).reshape(-1, values.shape[1])
    return values
