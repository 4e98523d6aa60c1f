"""RoboCASSearch-v1: find a hidden object in a heap, clear what covers it, drop it into the basket."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from robocas_ms3.core.arrays import as_tensor, native, none
from robocas_ms3.scenes.targets import selection_camera
from robocas_ms3.scenes.task_specs import SEARCH
from robocas_ms3.tasks import occlusion, rewards, terms
from robocas_ms3.tasks.learning import DENSE, LearningEnv
from robocas_ms3.tasks.schedule import PeriodicSchedule
from robocas_ms3.tasks.transfer import STAGES

# of each object's surface; hidden shares are then off ray casting by 0.03 on average, 0.08 at the 95th percentile
_POINTS = 512
LOOKS_PER_SECOND = 5  # at what is cleared
ENVS_AT_ONCE = 512  # whose clutter is measured: a quarter of a GB with 15 objects each


class RoboCASSearchEnv(LearningEnv):
    """Search: the target is hidden in part (p_vis from above below ``target.max_visible_share``, where one is given).

    The stages add ``obstacles_cleared``: to the camera above that p_vis is measured with, at most a fifth of the target
    is hidden, and fewer than two other objects stick out next to it (`occlusion.clutter`). It is looked at five times a
    second. What counts is the heap while the target lies in it: from the moment the gripper has held the target,
    nothing is cleared any more, so pulling or dragging it out from under the heap does not reach this stage.

    ``cleared_at_reset`` (N,) bool says that the target lay clear from the beginning: then the stage says nothing of
    what was done.
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
        eye = selection_camera(self.model).pose[:3, 3]
        self._eye = torch.as_tensor(eye, dtype=torch.float32, device=self.device)
        self._looked: _Look | None = None
        self._schedule = PeriodicSchedule(self.num_envs, self._look_period, self.device)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        if not hasattr(self, "hidden_share"):
            self.hidden_share = torch.zeros(self.num_envs, device=self.device)
            self._cleared_at_reset = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
            self._obstacles = torch.zeros_like(self.present)
            self._push_point = torch.zeros(self.num_envs, 3, device=self.device)
            self._look_again = torch.zeros_like(self._cleared_at_reset)  # whatever the time
            self._begins = torch.zeros_like(self._cleared_at_reset)
        self._looked = None
        self._schedule.reset(env_idx.cpu().numpy())
        self._begins[env_idx] = True
        self._look_again[env_idx] = True

    def state_beside_bodies(self) -> dict:
        """See `TransferEnv`; ``task`` also holds ``cleared_at_reset`` and ``hidden_share``, (N, 1) each."""
        state = super().state_beside_bodies()
        kept = {"cleared_at_reset": self._cleared_at_reset, "hidden_share": self.hidden_share}
        return {**state, "task": {**state["task"], **{name: value[:, None].clone() for name, value in kept.items()}}}

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """Set the state; see `RoboCASEnv`. A heap that is not cleared is looked at anew, at once."""
        super().set_state_dict(state, env_idx)
        envs = slice(None) if env_idx is None else env_idx
        self._schedule.every_step(slice(None) if env_idx is None else env_idx.cpu().numpy())
        self._looked = None  # else what follows would hang on what was before
        self._begins[envs], self._look_again[envs] = False, True
        self._cleared_at_reset = self._cleared_at_reset.clone()  # infos hold it
        own = {"cleared_at_reset": self._cleared_at_reset, "hidden_share": self.hidden_share}
        for name, kept in state.get("task", {}).items():
            if name in own:
                own[name][envs] = torch.as_tensor(kept).to(own[name]).reshape(-1)

    def clutter(self, envs: Any = slice(None)) -> occlusion.Clutter:
        """What hides and surrounds the targets of some envs right now."""
        points = occlusion.surface_points(self.object_states[envs, :, :7], self._surface_points[envs])
        return occlusion.clutter(points, self.present[envs], self.target_slot[envs], self._eye)

    def covering(self, envs: Any = slice(None)) -> torch.Tensor:
        """(E, K, K) share of each object (column) that each other one (row) hides, as `occlusion.covering`."""
        points = occlusion.surface_points(self.object_states[envs, :, :7], self._surface_points[envs])
        return occlusion.covering(points, self.present[envs], self._eye)

    def evaluate(self) -> dict[str, torch.Tensor]:
        """See `TransferEnv`; ``cleared_at_reset`` besides."""
        found = super().evaluate()
        self._cleared_at_reset = torch.where(self._begins, found["obstacles_cleared"], self._cleared_at_reset)
        self._begins = torch.zeros_like(self._begins)
        return {**found, "cleared_at_reset": self._cleared_at_reset}

    def _known_by(self, forces: Any) -> object:
        known = super()._known_by(forces)
        waits = self._looked is None or self._looked.others != self.bodies.others
        return None if waits and not none(self._due()) else known

    def _before_control_step(self) -> None:
        super()._before_control_step()
        self._schedule.advance()

    @property
    def _look_period(self) -> int:
        """Control steps from one look at the clutter to the next."""
        return max(1, self.control_freq // LOOKS_PER_SECOND)

    def _due(self) -> Any:
        """(N,) bool, native: whose clutter is looked at in this step."""
        settled = native(self._stages["target_grasped"]) | native(self._stages["obstacles_cleared"])
        return ((native(self.elapsed_steps) % self._look_period == 0) | native(self._look_again)) & ~settled

    def _task_stages(self, objects: Any, held: Any) -> dict[str, Any]:
        """``obstacles_cleared``, (N,) bool, of this moment; nothing in steps in which no env is looked at."""
        due = self._due() & ~held
        if none(due):
            return {}
        lies = terms.of_target(objects[..., 2], native(self.target_slot)) > self._surface - terms.FALLEN
        return {"obstacles_cleared": native(self._look(as_tensor(due), as_tensor(objects[..., :7]))) & lies & due}

    def _look(self, due: torch.Tensor, poses: torch.Tensor) -> torch.Tensor:
        """(N,) bool, which of the envs that are due are cleared; keeps their hidden shares and obstacles.

        Args:
            due: (N,) bool.
            poses: (N, K, 7) of the objects.
        """
        others, looked = self.bodies.others, self._looked
        if others is not None and looked is not None:  # on a CPU it is known whether anything has moved
            still = looked.others == others or not self._moved(poses, looked.poses)
            if still:
                self._looked = looked._replace(others=others)
                return looked.cleared
        cleared = torch.zeros_like(due)
        # on a GPU some envs more than are due, as finding these would wait for it; what is found of them is not taken
        looked_at = self._schedule.due() if self.gpu_sim_enabled else due.nonzero()[:, 0]
        for envs in looked_at.split(ENVS_AT_ONCE):
            found, taken = self.clutter(envs), due[envs]
            cleared[envs] = found.cleared & taken
            self.hidden_share[envs] = torch.where(taken, found.hidden_share, self.hidden_share[envs])
            self._obstacles[envs] = torch.where(taken[:, None], found.obstacles, self._obstacles[envs])
            if self._reward_mode in DENSE:
                points = occlusion.surface_points(poses[envs], self._surface_points[envs])
                push_point = occlusion.push_point(points, found.obstacles, self.target_slot[envs])
                self._push_point[envs] = torch.where(taken[:, None], push_point, self._push_point[envs])
        self._looked, self._look_again = _Look(others, poses, cleared), self._look_again & ~due
        return cleared

    def _moved(self, poses: torch.Tensor, before: torch.Tensor) -> bool:
        return bool(occlusion.moved_near(poses, before, self._radii, self.target_slot, self._eye).any())

    def _progress(self) -> tuple[Any, dict[str, Any]]:
        """As of `LearningEnv`; before the target may be grasped it has to be cleared, or must have been held."""
        stage, found = super()._progress()
        settled = native(self._stages["obstacles_cleared"]) | native(self._stages["target_grasped"])
        covered = (stage == self.REWARDS.index("grasp")) & ~settled
        if none(covered):
            return stage, found
        found["push_point"] = rewards.closeness(self.tcp_in_world()[:, :3], native(self._push_point))
        found["clear"] = rewards.uncovered(native(self.hidden_share), native(self._obstacles.sum(dim=1)))
        return rewards.furthest(stage, [(covered, self.REWARDS.index("clear"))]), found

    def _privileged(self) -> dict[str, torch.Tensor]:
        """As of `LearningEnv`, and ``hidden_share`` (N, 1) at the last look; there is none once the target was held."""
        return {**super()._privileged(), "hidden_share": self.hidden_share[:, None].clone()}


class _Look(NamedTuple):
    """The last look at the clutter.

    Attributes:
        others: all but the robot as it was then, on a CPU.
        poses: (N, K, 7) of the objects when it was last measured.
        cleared: (N,) bool, what was found.
    """

    others: object
    poses: torch.Tensor
    cleared: torch.Tensor


def _sample(points: np.ndarray) -> np.ndarray:
    """``_POINTS`` of points (P, 3), evenly from the first to the last; some repeat where there are fewer."""
    return points[np.linspace(0, len(points) - 1, _POINTS).round().astype(int)]
