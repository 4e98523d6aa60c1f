"""Controllers of joints: the arm's, moved evenly; fingers that do the same; a base that is held."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from mani_skill.agents.controllers import (
    PDJointPosControllerConfig,
    PDJointPosMimicController,
    PDJointPosMimicControllerConfig,
)

from robocas_ms3.core.arrays import as_tensor, choose, clamp, join, native
from robocas_ms3.robots.drives import (
    ARM_SET_FROM_OUTSIDE,
    HELD_SET_FROM_OUTSIDE,
    BatchedDrives,
    DirectDrives,
    EvenDrives,
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
