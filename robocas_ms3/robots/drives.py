"""Joint drives without ManiSkill's detours, on tensors or, on a CPU, on SAPIEN's joints themselves."""

from __future__ import annotations

from typing import Any, cast

import torch
from mani_skill.agents.controllers import PDJointPosController
from sapien.physx import PhysxArticulationJoint

from robocas_ms3.core.arrays import as_tensor, clamp, to_native

# Distances of a joint from its drive target (rad, m) that no motion explains: the state was set from outside.
ARM_RESET_DISTANCE, BASE_RESET_DISTANCE = 0.3, 0.02


class BatchedDrives(PDJointPosController):
    """ManiSkill's joint positions, whose drive targets are written on a GPU without waiting for it."""

    def set_drive_targets(self, targets: torch.Tensor) -> None:
        """Set the targets (N, joints), rad or m, of all joints in all envs."""
        if self.scene.gpu_sim_enabled:
            self._write(cast("Any", self.scene.px).cuda_articulation_target_qpos, targets)
        else:
            super().set_drive_targets(targets)

    def _write(self, buffer: Any, values: torch.Tensor) -> None:
        """Write values (N, joints) to a buffer of the GPU; ManiSkill indexes with a mask, for which the host waits."""
        buffer.torch()[self.articulation.get_joint_target_indices(self.joints)] = values


class DirectDrives(BatchedDrives):
    """Works on native arrays (`arrays`), and on a CPU without ManiSkill's wrapper of each joint.

    These would take longer than the physics.
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

    def _taken(self, action: Any) -> Any:
        """An action (N, size) tensor, native and scaled."""
        return self._preprocess_action(to_native(action))

    def _now(self) -> Any:
        """(N, joints) present positions, rad or m, native."""
        if self.scene.gpu_sim_enabled:
            return self.qpos
        return self.articulation._objs[0].qpos[None, self._columns]

    def set_drive_targets(self, targets: torch.Tensor) -> None:
        """Set the targets (N, joints), rad or m, of all joints in all envs."""
        if self.scene.gpu_sim_enabled:
            super().set_drive_targets(targets)
        else:
            self._drive_to(targets[0].tolist())

    def _drive_to(self, targets: list[float]) -> None:
        for drive, target in zip(self._drives, targets, strict=True):
            drive.set_drive_target(target)

    def set_drive_velocities(self, velocities: torch.Tensor) -> None:
        """Set the velocities (N, joints), rad/s or m/s, that the drives of all joints aim at in all envs."""
        if self.scene.gpu_sim_enabled:
            self._write(cast("Any", self.scene.px).cuda_articulation_target_qvel, velocities)
            return
        for drive, velocity in zip(self._drives, velocities[0].tolist(), strict=True):
            drive.set_drive_velocity_target(velocity)


class InterpolatedDrives(DirectDrives):
    """Moves the drive targets evenly from one to the next within a control step."""

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        shares = torch.arange(1, self._sim_steps + 1, device=self.device) / self._sim_steps
        self._shares = shares[:, None, None]
        self._ahead: list[Any] = []
        self._step = 0

    def _move_evenly(self, start: Any, end: Any) -> None:
        """Plan the control step's drive targets, from after ``start`` (N, joints) to ``end``, native."""
        targets = torch.lerp(as_tensor(start), as_tensor(end), self._shares)  # (steps, N, joints)
        self._ahead = list(targets) if self.scene.gpu_sim_enabled else targets[:, 0].tolist()
        self._step = 0

    def before_simulation_step(self) -> None:
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
        super().reset()
        self._ahead = []
