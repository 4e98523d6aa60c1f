"""RoboCASSearch-v1: find a hidden object in a heap, clear what covers it, drop it into the basket."""

from __future__ import annotations

import numpy as np
import torch
from mani_skill.utils.registration import register_env

from robocas_ms3.tasks import occlusion
from robocas_ms3.tasks.spec import SEARCH
from robocas_ms3.tasks.transfer import STAGES, TransferEnv

# of each object's surface; hidden shares are then off ray casting by 0.03 on average, 0.08 at the 95th percentile
_POINTS = 512
FALLEN = 0.05  # m below the surface that objects stand on, at which one counts as fallen off it


@register_env(SEARCH.env_id, max_episode_steps=SEARCH.max_episode_steps)
class RoboCASSearchEnv(TransferEnv):
    """Search: the target is hidden in part (p_vis from above below ``target.max_visible_share``).

    The stages add ``obstacles_cleared``: at most a fifth of the target is hidden from straight above, and fewer than
    two other objects stick out next to it (`occlusion.clutter`). What counts is the heap while the target lies in it:
    from the moment the gripper has held the target, nothing is cleared any more, so pulling or dragging it out from
    under the heap does not reach this stage.
    """

    SPEC = SEARCH
    STAGES = ("obstacles_cleared", *STAGES)

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        points = [[_sample(asset.annotations.surface_points) for asset in row] for row in self.object_assets]
        self._surface_points = torch.as_tensor(np.array(points), dtype=torch.float32, device=self.device)
        self._cleared: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None = None

    def clutter(self) -> occlusion.Clutter:
        """What hides and surrounds each env's target right now."""
        points = occlusion.surface_points(self.object_poses, self._surface_points)
        return occlusion.clutter(points, self.present, self.target_slot)

    def task_stages(self) -> dict[str, torch.Tensor]:
        """``obstacles_cleared``, (N,) bool, of this moment."""
        if self._stages["obstacles_cleared"].all():  # it stays so: no need to measure again
            return {}
        env, poses = torch.arange(self.num_envs, device=self.device), self.object_poses
        # most of the time nothing in the heap moves, and what was measured stays so
        if self._cleared is None or not (
            torch.equal(self._cleared[0], poses) and torch.equal(self._cleared[1], self.target_slot)
        ):
            self._cleared = poses, self.target_slot.clone(), self.clutter().cleared
        surface = float(self.model.support_pose[2, 3]) + self.model.region.z
        lies = poses[env, self.target_slot, 2] > surface - FALLEN
        lies &= ~(self.target_held | self._stages["target_grasped"])
        return {"obstacles_cleared": self._cleared[2] & lies}


def _sample(points: np.ndarray) -> np.ndarray:
    """``_POINTS`` of points (P, 3), evenly from the first to the last; some repeat where there are fewer."""
    return points[np.linspace(0, len(points) - 1, _POINTS).round().astype(int)]
