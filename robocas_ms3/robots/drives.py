"""Fast joint drives: write drive targets to GPU buffers, or directly to SAPIEN joints on a CPU."""

from __future__ import annotations

from typing import Any, cast

import torch
from mani_skill.agents.controllers import PDJointPosController
from sapien.physx import PhysxArticulationJoint

from robocas_ms3.core.arrays import as_tensor, clamp, to_native

# rad, m; a joint farther from its drive target was moved by setting the simulation state, not by the drive
ARM_RESET_DISTANCE, BASE_RESET_DISTANCE = 0.3, 0.02


class BatchedDrives(PDJointPosController):
    """Joint position controller that writes drive targets to GPU buffers without waiting for the GPU."""

    def set_drive_targets(self, targets: torch.Tensor) -> None:
        """Set the drive targets (N, joints) in rad or m of all joints in all envs."""
        if self.scene.gpu_sim_enabled:
            self._write(cast("Any", self.scene.px).cuda_articulation_target_qpos, targets)
        else:
            super().set_drive_targets(targets)

    def _write(self, buffer: Any, values: torch.Tensor) -> None:
        """Write values (N, joints) to a GPU buffer. ManiSkill's index by a mask would wait for the GPU."""
        buffer.torch()[self.articulation.get_joint_target_indices(self.joints)] = values


class DirectDrives(BatchedDrives):
    """Controller that works on native arrays (`core.arrays`), and on a CPU on SAPIEN joints.

    ManiSkill's joint wrappers would take longer than the physics.
    """

    action_space_low: Any
    action_space_high: Any

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        self._drives: list[PhysxArticulationJoint] = [joint._objs[0] for joint in self.joints]
        self._columns = to_native(self.active_joint_indices)

    def _clip_and_scale_action_space(self) -> None:
        super()._clip_and_scale_action_space()
        low, high = to_native(self.action_space_low), to_native(self.action_space_high)
        self._middle, self._half = 0.5 * (high + low), 0.5 * (high - low)

    def _clip_and_scale_action(self, action: Any) -> Any:
        return self._middle + self._half * clamp(action, -1, 1)

    def _scale_action(self, action: Any) -> Any:
        """Convert an action tensor (N, size) to a scaled native array."""
        return self._preprocess_action(to_native(action))

    def _current_qpos(self) -> Any:
        """Return the current joint positions (N, joints) in rad or m as a native array."""
        if self.scene.gpu_sim_enabled:
            return self.qpos
        return self.articulation._objs[0].qpos[None, self._columns]

    def set_drive_targets(self, targets: torch.Tensor) -> None:
        """Set the drive targets (N, joints) in rad or m of all joints in all envs."""
        if self.scene.gpu_sim_enabled:
            super().set_drive_targets(targets)
        else:
            self._drive_to(targets[0].tolist())

    def _drive_to(self, targets: list[float]) -> None:
        for drive, target in zip(self._drives, targets, strict=True):
            drive.set_drive_target(target)

    def set_drive_velocities(self, velocities: torch.Tensor) -> None:
        """Set the velocity targets (N, joints) in rad/s or m/s of all joints in all envs."""
        if self.scene.gpu_sim_enabled:
            self._write(cast("Any", self.scene.px).cuda_articulation_target_qvel, velocities)
            return
        for drive, velocity in zip(self._drives, velocities[0].tolist(), strict=True):
            drive.set_drive_velocity_target(velocity)


class InterpolatedDrives(DirectDrives):
    """Controller that interpolates drive targets linearly within a control step."""

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        fractions = torch.arange(1, self._sim_steps + 1, device=self.device) / self._sim_steps
        self._fractions = fractions[:, None, None]
        self._remaining_targets: list[Any] = []
        self._step = 0

    def _interpolate(self, start: Any, end: Any) -> None:
        """Set the drive targets of the next control step: from ``start`` (N, joints), excluded, to ``end``."""
        targets = torch.lerp(as_tensor(start), as_tensor(end), self._fractions)  # (steps, N, joints)
        self._remaining_targets = list(targets) if self.scene.gpu_sim_enabled else targets[:, 0].tolist()
        self._step = 0

    def before_simulation_step(self) -> None:
        if self._step >= len(self._remaining_targets):
            return
        targets = self._remaining_targets[self._step]
        self._step += 1
        if self.scene.gpu_sim_enabled:
            self.set_drive_targets(targets)
            cast("Any", self.scene.px).gpu_apply_articulation_target_position()
        else:
            self._drive_to(targets)

    def reset(self) -> None:
        super().reset()
        self._remaining_targets = []
