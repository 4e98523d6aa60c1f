"""Gymnasium vector environment for the episodes of one task of a protocol, with LeRobot's conventions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from copy import deepcopy
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space, create_empty_array
from numpy.typing import ArrayLike, NDArray

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.harness.proprioception import (
    CALIBRATION_SHAPES,
    WIDTHS,
    Proprioception,
    camera_pose_key,
    depth_key,
    intrinsics_key,
)
from robocas_ms3.evaluation.policy import CONVENTIONS, ExternalPolicy, Observations, PolicySpec
from robocas_ms3.evaluation.results.outcomes import Outcome
from robocas_ms3.evaluation.results.result_files import append_episode, open_result
from robocas_ms3.evaluation.rollouts.rollout import CameraObservations
from robocas_ms3.evaluation.rollouts.session import EvaluationSession
from robocas_ms3.evaluation.settings import EvaluationSettings


class ProtocolVectorEnv(gym.vector.VectorEnv):
    """Vector environment that runs the episodes of one task of a protocol, N at a time.

    - Seed: index of an episode in the list of the task's episodes, modulo the length of the list.
    - No automatic reset: an env whose episode has ended returns its last observation until the next reset.
    - Observations: ``pixels`` by camera, (N, H, W, 3) uint8. State columns of LeRobot datasets, float32: ``agent_pos``
      (N, 18), ``joint_velocity`` (N, 7), ``arm_base`` (N, 7) and ``gripper_open`` (N, 1). With depth also
      ``images.CAMERA_depth`` (N, 1, H, W) float32 in mm, 0: no measurement. ``intrinsics.CAMERA`` (N, 3, 3) and
      ``camera_in_base.CAMERA`` (N, 4, 4), as in `Observations`.
    - Reward: 1 at the step at which an episode ends with success, else 0.
    - ``info["is_success"]`` (N,) bool: whether the episode has succeeded; at the end of an episode also in
      ``info["final_info"]``.

    Args:
        spec: cameras, action convention and rate.
        settings: protocol, task (``tasks``), number of envs, backend, split and policy name; ``out``: folder of the
            result, None: no result is written.
    """

    def __init__(self, spec: PolicySpec, settings: EvaluationSettings) -> None:
        self._session = EvaluationSession(ExternalPolicy(spec), settings)
        self._episodes = self._session.episodes
        if settings.envs > 1:
            splits = ", ".join(dict.fromkeys(episode.split for episode in self._episodes))
            self._session.protocol.check_same_configuration(
                self._episodes, f"Select one of the splits {splits}, or use one env."
            )
        self._task = self._episodes[0].task
        self._max_steps = self._session.max_steps(self._task)
        self._lock = ExitStack()
        self._folder, self._recorded = settings.out, set[int]()  # episodes that were written
        if (folder := settings.out) is not None:
            with ExitStack() as lock:
                if lock.enter_context(open_result(folder, self._session.run_record)):
                    what, fix = "the output folder already has a result", "Choose another folder, or delete this one."
                    raise EvaluationError(what, where=folder, fix=fix)
                self._lock = lock.pop_all()  # held until `close`
        self._convention = CONVENTIONS[spec.convention]
        self._proprioception = Proprioception(self._session.protocol.rules.robot)
        self._spec, self._next = spec, 0
        count = self.num_envs = settings.envs
        self.render_mode = "rgb_array"
        rate = self._session.rate
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": rate, "autoreset_mode": AutoresetMode.DISABLED}
        self.single_observation_space = _make_observation_space(spec)
        self.single_action_space = gym.spaces.Box(-np.inf, np.inf, (self._convention.size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, count)
        self.action_space = batch_space(self.single_action_space, count)
        self.episodes = np.zeros(count, np.int64)  # episode numbers of the protocol
        self._instructions = [""] * count
        self._grippers: list[float | None] = [None] * count  # last command, -1 closed to 1 open
        self._obs: dict[str, Any] = {}

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode in each env; return the first observations and ``info``.

        Args:
            seed: seed of the first env; the other envs get the next seeds. A list has one seed per env. None: continue
                with the episodes after those of the last reset.
            options: ignored.
        """
        first: Any = self._next if seed is None else seed
        seeds = [first + env for env in range(self.num_envs)] if np.ndim(first) == 0 else list(first)
        if len(seeds) != self.num_envs or any(one is None for one in seeds):
            raise ValueError(f"seed: expected one integer, or one per env ({self.num_envs}), found {seeds}")
        indices = [int(one) % len(self._episodes) for one in seeds]
        self._next = indices[-1] + 1
        episodes = [self._episodes[index] for index in indices]
        observations = self._session.reset([episode.episode for episode in episodes])
        self.episodes = np.array([episode.episode for episode in episodes], np.int64)
        self._instructions = [episode.instruction for episode in episodes]
        self._grippers = [None] * self.num_envs
        self._proprioception.reset(self._session.observation)
        self._obs = cast(dict[str, Any], create_empty_array(self.single_observation_space, self.num_envs))
        self._update_observations(list(range(self.num_envs)), observations)
        return deepcopy(self._obs), self._make_info(np.zeros(self.num_envs, bool))  # a copy: the caller may keep it

    def step(
        self, actions: ArrayLike
    ) -> tuple[dict[str, Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Execute actions (N, A) in the envs whose episode is running; return what gymnasium's ``step`` returns."""
        acts = np.asarray(actions, np.float32)
        if acts.shape != self.action_space.shape:
            raise ValueError(f"actions: expected shape {self.action_space.shape}, found {acts.shape}")
        if not self._obs:
            raise EvaluationError("no episode is running", fix="Call reset before step.")
        before = self._has_ended(lambda outcome: True)
        if running := np.flatnonzero(~before).tolist():
            observations = self._session.step(acts)
            for env, command in zip(running, self._gripper_commands(acts[running]), strict=True):
                self._grippers[env] = command
            self._update_observations(running, observations)
        ended = self._has_ended(lambda outcome: True)
        self._write_episodes(np.flatnonzero(ended & ~before).tolist())
        truncated = self._has_ended(lambda outcome: not outcome.success and outcome.steps >= self._max_steps)
        info = self._make_info(ended & ~before)
        reward = (info["is_success"] & ~before).astype(np.float64)
        return deepcopy(self._obs), reward, ended & ~truncated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...]:
        """Return the last image (H, W, 3) uint8 of the first camera for each env."""
        return tuple(next(iter(self._obs["pixels"].values())).copy())

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return the value of ``task``, ``task_description`` or ``_max_episode_steps`` for each env."""
        if name == "task_description":
            return tuple(self._instructions)
        shared = {"task": self._task, "_max_episode_steps": self._max_steps}
        if name not in shared:
            raise AttributeError(f"unknown attribute: expected task_description, {' or '.join(shared)}, found {name}")
        return (shared[name],) * self.num_envs

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        return self.render() if name == "render" else self.get_attr(name)

    def close_extras(self, **kwargs: Any) -> None:
        self._session.close()
        self._lock.close()

    def _gripper_commands(self, actions: NDArray[np.float32]) -> list[float]:
        if self._convention.decode is None:
            return actions[:, -1].tolist()
        opened = self._convention.decode(np.nan_to_num(actions.astype(np.float64))).open
        return np.where(opened, 1.0, -1.0).tolist()

    def _has_ended(self, condition: Callable[[Outcome], bool]) -> NDArray[np.bool_]:
        """Return (N,) bool, whether the episode of each env has ended and its outcome satisfies ``condition``."""
        outcomes = [self._session.outcomes.get(env) for env in range(self.num_envs)]
        return np.array([outcome is not None and condition(outcome) for outcome in outcomes])

    def _write_episodes(self, envs: list[int]) -> None:
        """Write the outcomes and the actions of the given envs to the result, each episode once."""
        for env in envs:
            evaluated = self._session.evaluated[env]
            number = evaluated.outcome.episode
            if self._folder is not None and number not in self._recorded:
                append_episode(self._folder, evaluated)
                self._recorded.add(number)

    def _update_observations(self, envs: list[int], observations: Observations | None) -> None:
        """Update the observations of some envs; ``observations``: those of the envs whose episode is running."""
        obs = self._session.observation
        for env in envs:
            for name, values in self._proprioception.compute_columns(env, obs, self._grippers[env]).items():
                self._obs[name][env] = values
        if observations is not None:
            self._store_cameras(observations.envs.tolist(), observations)
        if ended := [env for env in envs if observations is None or env not in observations.envs]:
            self._store_cameras(ended, self._session.observe_cameras(ended))

    def _store_cameras(self, envs: list[int], cameras: Observations | CameraObservations) -> None:
        for camera in self._spec.cameras:
            self._obs["pixels"][camera][envs] = cameras.images[camera]
            self._obs[intrinsics_key(camera)][envs] = cameras.intrinsics[camera]
            self._obs[camera_pose_key(camera)][envs] = cameras.camera_in_base[camera]
            if self._spec.depth:
                self._obs[depth_key(camera)][envs] = cameras.depths[camera].transpose(0, 3, 1, 2)

    def _make_info(self, just_ended: NDArray[np.bool_]) -> dict[str, Any]:
        success = self._has_ended(lambda outcome: outcome.success)
        info: dict[str, Any] = {"is_success": success, "_is_success": np.ones(self.num_envs, bool)}
        if just_ended.any():
            info["final_info"] = {"is_success": success.copy(), "_is_success": just_ended}
            info["_final_info"] = just_ended
        return info


def _make_observation_space(spec: PolicySpec) -> gym.spaces.Dict:
    depths = [(depth_key(name), (1, h, w)) for name, (w, h) in spec.cameras.items()] if spec.depth else []
    calibration = [(key(name), shape) for key, shape in CALIBRATION_SHAPES.items() for name in spec.cameras]
    shapes = [*((name, (width,)) for name, width in WIDTHS.items()), *depths, *calibration]
    numbers: dict[str, gym.Space[Any]] = {name: gym.spaces.Box(-np.inf, np.inf, shape) for name, shape in shapes}
    pixels: dict[str, gym.Space[Any]] = {
        name: gym.spaces.Box(0, 255, (h, w, 3), np.uint8) for name, (w, h) in spec.cameras.items()
    }
    return gym.spaces.Dict({"pixels": gym.spaces.Dict(pixels), **numbers})
