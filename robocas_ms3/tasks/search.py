"""RoboCASSearch-v1: find a hidden object in a heap, clear what covers it, drop it into the basket."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from mani_skill.utils.registration import register_env

from robocas_ms3.arrays import as_tensor, native
from robocas_ms3.tasks import occlusion, rewards, terms
from robocas_ms3.tasks.learning import LearningEnv
from robocas_ms3.tasks.spec import SEARCH
from robocas_ms3.tasks.transfer import STAGES

# of each object's surface; hidden shares are then off ray casting by 0.03 on average, 0.08 at the 95th percentile
_POINTS = 512


@register_env(SEARCH.env_id, max_episode_steps=SEARCH.max_episode_steps)
class RoboCASSearchEnv(LearningEnv):
    """Search: the target is hidden in part (p_vis from above below ``target.max_visible_share``).

    The stages add ``obstacles_cleared``: at most a fifth of the target is hidden from straight above, and fewer than
    two other objects stick out next to it (`occlusion.clutter`). What counts is the heap while the target lies in it:
    from the moment the gripper has held the target, nothing is cleared any more, so pulling or dragging it out from
    under the heap does not reach this stage.
    """

    SPEC = SEARCH
    STAGES = ("obstacles_cleared", *STAGES)
    REWARDS = rewards.SEARCH

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        points = [[_sample(asset.annotations.surface_points) for asset in row] for row in self.object_assets]
        columns = np.ascontiguousarray(np.array(points).swapaxes(-1, -2))
        self._surface_points = torch.as_tensor(columns, dtype=torch.float32, device=self.device)
        self._radii = torch.linalg.vector_norm(self._surface_points, dim=-2).amax(dim=-1)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        self._last_clutter: tuple[torch.Tensor, occlusion.Clutter] | None = None
        self._last_push: torch.Tensor | None = None  # of that clutter

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """Set the state; see `RoboCASEnv`."""
        super().set_state_dict(state, env_idx)
        self._last_clutter = None  # else what follows would hang on what was before

    def clutter(self) -> occlusion.Clutter:
        """What hides and surrounds each env's target right now."""
        points = occlusion.surface_points(self.object_states[..., :7], self._surface_points)
        return occlusion.clutter(points, self.present, self.target_slot)

    def _task_stages(self, objects: Any, held: Any) -> dict[str, Any]:
        """``obstacles_cleared``, (N,) bool, of this moment."""
        taken = held | native(self._stages["target_grasped"])
        if (taken | native(self._stages["obstacles_cleared"])).all():  # nothing can change it any more
            return {}
        lies = terms.of_target(objects[..., 2], native(self.target_slot)) > self._surface - terms.FALLEN
        return {"obstacles_cleared": native(self._clutter_at(as_tensor(objects[..., :7])).cleared) & lies & ~taken}

    def _clutter_at(self, poses: torch.Tensor) -> occlusion.Clutter:
        """`clutter` at these poses of now (N, K, 7), as it was when something in the heap last moved."""
        if self._last_clutter is not None:
            before, found = self._last_clutter
            if torch.equal(poses, before) or not self._moved(poses, before):
                return found
        found = self.clutter()
        self._last_clutter, self._last_push = (poses, found), None
        return found

    def _moved(self, poses: torch.Tensor, before: torch.Tensor) -> bool:
        return bool(occlusion.moved_near(poses, before, self._radii, self.target_slot).any())

    def _progress(self) -> tuple[Any, dict[str, Any]]:
        """As of `LearningEnv`; before the target may be grasped it has to be cleared, or must have been."""
        stage, found = super()._progress()
        assert self._moment is not None
        poses = as_tensor(self._moment.objects[..., :7])
        covered = (stage == self.REWARDS.index("grasp")) & ~native(self._stages["obstacles_cleared"])
        if not covered.any():
            return stage, found
        clutter = self._clutter_at(poses)
        if self._last_push is None:
            points = occlusion.surface_points(poses, self._surface_points)
            self._last_push = occlusion.push_point(points, clutter.obstacles, self.target_slot)
        found["push_point"] = rewards.closeness(self._tcp()[:, :3], native(self._last_push))
        found["clear"] = rewards.uncovered(native(clutter.hidden_share), native(clutter.obstacles.sum(dim=1)))
        return rewards.furthest(stage, [(covered & ~native(clutter.cleared), self.REWARDS.index("clear"))]), found

    def _privileged(self) -> dict[str, torch.Tensor]:
        """As of `LearningEnv`, and ``hidden_share`` (N, 1), 0 from when the target was first held."""
        share = torch.where(
            self._stages["target_grasped"], 0.0, self._clutter_at(self.object_states[..., :7]).hidden_share
        )
        return {**super()._privileged(), "hidden_share": share[:, None]}


def _sample(points: np.ndarray) -> np.ndarray:
    """``_POINTS`` of points (P, 3), evenly from the first to the last; some repeat where there are fewer."""
    return points[np.linspace(0, len(points) - 1, _POINTS).round().astype(int)]
