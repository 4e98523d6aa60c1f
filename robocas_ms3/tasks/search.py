"""RoboCASSearch-v1: find a hidden object in a heap, clear obstacles, and put it into the basket."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.core.arrays import Array, as_tensor, known_all_false, to_native
from robocas_ms3.scenes.targets import selection_camera
from robocas_ms3.scenes.task_specs import SEARCH
from robocas_ms3.tasks import occlusion, rewards, terms
from robocas_ms3.tasks.base import STAGES, RoboCASEnv
from robocas_ms3.tasks.rewards import DENSE_MODES

MEASUREMENTS_PER_SECOND = 5  # of the clutter around the target
ENVS_AT_ONCE = 512  # envs whose clutter is measured in one tensor operation: 0.25 GB with 15 objects per env


class RoboCASSearchEnv(RoboCASEnv):
    """Find a partly hidden object in a heap, and put it into the basket.

    At the start, the visible fraction of the target, seen from above, is below ``target.max_visible_share`` of the task
    configuration, if this is set.

    The additional stage ``obstacles_cleared`` is reached when, seen from above, at most 20 % of the target is hidden
    and at most one obstacle is next to it (`occlusion.Clutter`). This is measured five times per second until the
    gripper has held the target. So a policy that pulls the target out from under the heap does not reach the stage.

    ``info["cleared_at_reset"]`` (N,) bool reports whether the stage was already reached at the start of the episode.

    Attributes:
        hidden_fraction: (N,) last measured hidden fraction of the target.
    """

    SPEC = SEARCH
    STAGES = ("obstacles_cleared", *STAGES)
    REWARDS = rewards.SEARCH

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        points = [
            [occlusion.sample_points(asset.annotations.surface_points) for asset in row] for row in self.object_assets
        ]
        columns = np.ascontiguousarray(np.array(points).swapaxes(-1, -2))
        self._surface_points = torch.as_tensor(columns, dtype=torch.float32, device=self.device)
        self._radii = torch.linalg.vector_norm(self._surface_points, dim=-2).amax(dim=-1)
        eye = selection_camera(self.model).pose[:3, 3]
        self._eye = torch.as_tensor(eye, dtype=torch.float32, device=self.device)
        self._schedule = PeriodicSchedule(self.num_envs, self._measure_period, self.device)
        self._last_measurement: _Measurement | None = None
        flags = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self._cleared_at_reset, self._measure_now, self._just_reset = flags, flags.clone(), flags.clone()
        self.hidden_fraction = torch.zeros(self.num_envs, device=self.device)
        self._obstacles = torch.zeros_like(self.present)
        self._push_point = torch.zeros(self.num_envs, 3, device=self.device)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        self._last_measurement = None
        self._schedule.reset(env_idx.cpu().numpy())
        self._just_reset[env_idx] = True
        self._measure_now[env_idx] = True

    def extra_state(self) -> dict:
        """Return the extra state of `RoboCASEnv`, ``cleared_at_reset`` and ``hidden_fraction`` (N, 1)."""
        state = super().extra_state()
        own = {"cleared_at_reset": self._cleared_at_reset, "hidden_fraction": self.hidden_fraction}
        return {**state, "task": {**state["task"], **{name: value[:, None].clone() for name, value in own.items()}}}

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """Set the state of some envs as `RoboCASEnv` does; the next step measures their clutter."""
        super().set_state_dict(state, env_idx)
        envs = slice(None) if env_idx is None else env_idx
        self._schedule.make_always_due(slice(None) if env_idx is None else env_idx.cpu().numpy())
        self._last_measurement = None  # otherwise later results would depend on the state before
        self._just_reset[envs], self._measure_now[envs] = False, True
        self._cleared_at_reset = self._cleared_at_reset.clone()  # earlier infos refer to the old tensor
        own = {"cleared_at_reset": self._cleared_at_reset, "hidden_fraction": self.hidden_fraction}
        for name, value in state.get("task", {}).items():
            if name in own:
                own[name][envs] = torch.as_tensor(value).to(own[name]).reshape(-1)

    def measure_clutter(self, envs: Any = slice(None)) -> occlusion.Clutter:
        """Measure the current clutter around the targets of some envs (indices or a slice)."""
        points = occlusion.surface_points_in_world(self.object_states[envs, :, :7], self._surface_points[envs])
        return occlusion.measure_clutter(points, self.present[envs], self.target_slot[envs], self._eye)

    def measure_pairwise_occlusion(self, envs: Any = slice(None)) -> torch.Tensor:
        """Return the fraction (E, K, K) of each object that each other object hides, in some envs.

        Entry [e, i, j] is the fraction of object j that object i hides.
        """
        points = occlusion.surface_points_in_world(self.object_states[envs, :, :7], self._surface_points[envs])
        return occlusion.measure_pairwise_occlusion(points, self.present[envs], self._eye)

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Return the result of `RoboCASEnv.evaluate`, ``obstacles_cleared`` and ``cleared_at_reset``."""
        found, measured = super().evaluate(), self._last_measurement
        unchanged = (
            measured is not None
            and measured.state_except_robot is not None
            and measured.state_except_robot == self.bodies.state_except_robot
        )
        if not unchanged and not known_all_false(due := self._is_due()):
            state = self.success_check.state
            in_heap = (
                terms.select_target(state.object_states[..., 2], to_native(self.target_slot))
                > self.success_check.fallen_below
            )
            cleared = to_native(self._measure_due_envs(as_tensor(due), as_tensor(state.object_states[..., :7])))
            found["obstacles_cleared"] = self.success_check.mark_reached("obstacles_cleared", cleared & in_heap & due)
        cleared_at_reset = torch.where(self._just_reset, found["obstacles_cleared"], self._cleared_at_reset)
        self._cleared_at_reset, self._just_reset = cleared_at_reset, torch.zeros_like(self._just_reset)
        return {**found, "cleared_at_reset": cleared_at_reset}

    def _before_control_step(self) -> None:
        super()._before_control_step()
        self._schedule.advance()

    @property
    def _measure_period(self) -> int:
        """Number of control steps between two measurements of the clutter."""
        return max(1, self.control_freq // MEASUREMENTS_PER_SECOND)

    def _is_due(self) -> Array:
        """Return (N,) bool, native: whether the clutter of each env is measured in this step."""
        stages = self.success_check.stages
        settled = stages["target_grasped"] | stages["obstacles_cleared"]
        return ((to_native(self.elapsed_steps) % self._measure_period == 0) | to_native(self._measure_now)) & ~settled

    def _measure_due_envs(self, due: torch.Tensor, poses: torch.Tensor) -> torch.Tensor:
        """Measure and store the clutter of the due envs; return (N,) bool, whether each due target is cleared.

        Args:
            due: (N,) bool, whether the clutter of each env is measured.
            poses: (N, K, 7) world poses of the objects.
        """
        others, measured = self.bodies.state_except_robot, self._last_measurement
        if others is not None and measured is not None:  # on a CPU, motion is detected by comparing states
            unchanged = measured.state_except_robot == others or not self._has_clutter_moved(poses, measured.poses)
            if unchanged:
                self._last_measurement = measured._replace(state_except_robot=others)
                return measured.cleared
        cleared = torch.zeros_like(due)
        # on a GPU more envs than necessary are measured, since selecting them would synchronise
        envs_to_measure = self._schedule.due_envs() if self.gpu_sim_enabled else due.nonzero()[:, 0]
        for envs in envs_to_measure.split(ENVS_AT_ONCE):
            found, taken = self.measure_clutter(envs), due[envs]
            cleared[envs] = found.is_target_cleared & taken
            self.hidden_fraction[envs] = torch.where(taken, found.hidden_fraction, self.hidden_fraction[envs])
            self._obstacles[envs] = torch.where(taken[:, None], found.obstacles, self._obstacles[envs])
            if self._reward_mode in DENSE_MODES:
                points = occlusion.surface_points_in_world(poses[envs], self._surface_points[envs])
                push_point = occlusion.find_push_point(points, found.obstacles, self.target_slot[envs])
                self._push_point[envs] = torch.where(taken[:, None], push_point, self._push_point[envs])
        self._last_measurement, self._measure_now = _Measurement(others, poses, cleared), self._measure_now & ~due
        return cleared

    def _has_clutter_moved(self, poses: torch.Tensor, earlier_poses: torch.Tensor) -> bool:
        return bool(occlusion.has_clutter_moved(poses, earlier_poses, self._radii, self.target_slot, self._eye).any())

    def reward_stage_and_terms(self) -> tuple[Array, dict[str, Array]]:
        """Return reward stages (N,) and terms (N,) by name.

        The stage ``clear`` lasts until the target is cleared or held.
        """
        stage, found = super().reward_stage_and_terms()
        stages = self.success_check.stages
        settled = stages["obstacles_cleared"] | stages["target_grasped"]
        covered = (stage == self.REWARDS.stage_index("grasp")) & ~settled
        if not known_all_false(covered):
            found["push_point"] = rewards.nearness(self.tcp_in_world()[:, :3], to_native(self._push_point))
            found["clear"] = rewards.clear_fraction(
                to_native(self.hidden_fraction), to_native(self._obstacles.sum(dim=1))
            )
            stage = rewards.furthest_stage(stage, [(covered, self.REWARDS.stage_index("clear"))])
        return stage, found

    def privileged_observations(self) -> dict[str, torch.Tensor]:
        """Return the observations of all tasks, and the last measured ``hidden_fraction`` (N, 1)."""
        return {**super().privileged_observations(), "hidden_fraction": self.hidden_fraction[:, None].clone()}


class _Measurement(NamedTuple):
    """Measurement of the clutter.

    Attributes:
        state_except_robot: `BodyStateReader.state_except_robot` at the measurement.
        poses: (N, K, 7) world poses of the objects at the measurement.
        cleared: (N,) bool, whether the target was cleared.
    """

    state_except_robot: object
    poses: torch.Tensor
    cleared: torch.Tensor


class PeriodicSchedule:
    """Schedule of a measurement: due before the first step of an episode, then once per period.

    Args:
        num_envs: N.
        period: control steps from one measurement to the next.
        device: device of the envs.
    """

    def __init__(self, num_envs: int, period: int, device: torch.device | str) -> None:
        self._period, self._device = period, device
        self._step = 0
        self._reset_at = np.zeros(num_envs, dtype=np.int64)  # value of `_step` at the last reset
        self._always = np.zeros(num_envs, dtype=bool)
        self._indices: list[torch.Tensor] = []  # due envs by `_step` modulo the period; empty: not computed

    def reset(self, envs: NDArray[np.int64]) -> None:
        """Restart the schedule of some envs (E,), which have just been reset."""
        self._reset_at[envs], self._always[envs] = self._step, False
        self._indices = []

    def make_always_due(self, envs: NDArray[np.int64] | slice) -> None:
        """Make some envs due in every step until their next reset."""
        self._always[envs] = True
        self._indices = []

    def advance(self) -> None:
        """Go to the next control step."""
        self._step += 1

    def due_envs(self) -> torch.Tensor:
        """Return the indices (D,) int64 of the envs that are due in the current control step."""
        if not self._indices:  # for the whole period, because a copy to the GPU in each step would synchronise
            phases = np.arange(self._period)[:, None]
            due = ((phases - self._reset_at) % self._period == 0) | self._always
            self._indices = [torch.from_numpy(np.flatnonzero(row)).to(self._device) for row in due]
        return self._indices[self._step % self._period]
