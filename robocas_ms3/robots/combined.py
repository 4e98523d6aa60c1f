"""The robot's controllers as one: reset for some envs alone, their targets saved and restored."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import torch
from mani_skill.agents.controllers.base_controller import CombinedController
from mani_skill.utils.structs import Pose

State = Mapping[str, Mapping[str, Any]]
"""By controller: ``target_qpos`` (N, joints) rad or m; of the end effector ``target_pose`` (N, 7) in the arm's base."""


class RobotController(CombinedController):
    """ManiSkill's, but that a reset is of the envs that are being reset.

    ManiSkill resets controllers when it has already forgotten which envs these were, so that all others would take
    where they are for where they were told to go.
    """

    reset_only: torch.Tensor | None = None
    """Indices of the envs that the next reset is of; none: all."""

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
        """What the next actions start from, beside where the joints are; a copy."""
        found: dict[str, dict[str, torch.Tensor]] = {}
        for name, controller in self.controllers.items():
            part, kept = cast("Any", controller), found.setdefault(name, {})
            if part._target_qpos is not None:
                kept["target_qpos"] = part._target_qpos.clone()
            if getattr(part, "_target_pose", None) is not None:
                kept["target_pose"] = part._target_pose.raw_pose.clone()
        return found

    def set_targets(self, state: State | None = None, env_idx: torch.Tensor | None = None) -> None:
        """Let the next actions start from targets, and where there are none from where the joints are.

        Args:
            state: of `targets`, a row for each env that is set.
            env_idx: of these envs; default: all.
        """
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
    """A copy of values (N, D) with some rows replaced."""
    values = values.clone()
    rows = torch.as_tensor(rows, dtype=values.dtype, device=values.device)
    values[envs] = rows.reshape(-1, values.shape[1])
    return values
