"""Run episodes in several envs at a time, with one loop for all backends."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import PolicyError
from robocas_ms3.core.text import escape_controls
from robocas_ms3.evaluation.policy import (
    CONVENTIONS,
    ROBOT_QUANTITIES,
    EpisodeSpec,
    Observations,
    Policy,
    PolicySpec,
    SimulationState,
    as_action_chunks,
    concatenate_privileged_state,
    find_image_requests,
    forbid_policy_exit,
    get_class_name,
)
from robocas_ms3.evaluation.protocols.protocol import ProtocolEpisode
from robocas_ms3.evaluation.results.metrics import read_metric
from robocas_ms3.evaluation.results.outcomes import (
    MEASURES,
    NO_CHECKPOINTS,
    Checkpoints,
    Outcome,
    Retrieval,
    find_failure_stage,
)
from robocas_ms3.evaluation.rollouts.action_wrapper import CHECKPOINT
from robocas_ms3.evaluation.rollouts.calibration import CameraCalibration
from robocas_ms3.scenes.language.embed import TextEmbedder
from robocas_ms3.scenes.task_specs import TASKS

NOT_FINITE = "NaN or infinite action of the policy"
_WELDS = "welds"  # key of ``info`` with the weld (`weld.Weld`)
_CHECKPOINT_SECONDS = 1.0  # simulated time between checkpoints, if a policy step is a control step


@dataclass
class Rollout:
    """Values of an episode that is running or has ended.

    Attributes:
        spec: specification of the episode.
        steps, seconds, flags, flag_seconds, measures, error: as in `Outcome`.
        at_end: by stage or success rule, whether it holds after the last step.
        retrieval: (K, 3) record of `metrics.RetrievalTracker.compute_record` for this env; None except in search.
        inference_seconds: wall-clock time of the policy; the time for a batch is divided equally between its envs.
        actions: the executed actions, one (A,) float32 per policy step.
        checkpoints: policy step and state (D,) float32 of each checkpoint.
    """

    spec: EpisodeSpec
    steps: int = 0
    seconds: float = 0.0
    flags: dict[str, int | None] = field(default_factory=dict)
    flag_seconds: dict[str, float | None] = field(default_factory=dict)
    at_end: dict[str, bool] = field(default_factory=dict)
    measures: dict[str, float] = field(default_factory=dict)
    retrieval: NDArray[np.integer] | None = None
    inference_seconds: float = 0.0
    error: str = ""
    actions: list[NDArray[np.float32]] = field(default_factory=list, compare=False)
    checkpoints: list[tuple[int, NDArray[np.float32]]] = field(default_factory=list, compare=False)

    def stack_checkpoints(self) -> Checkpoints:
        """Return the checkpoints as arrays."""
        if not self.checkpoints:
            return NO_CHECKPOINTS
        steps, states = zip(*self.checkpoints, strict=True)
        return Checkpoints(np.array(steps, np.int32), np.stack(states))

    def make_outcome(self, episode: ProtocolEpisode, objects: Sequence[str]) -> Outcome:
        """Return the outcome of this rollout of an episode; ``objects``: ids of the K objects by slot."""
        flags, order = self.flags, None
        if self.retrieval is not None:
            cleared = flags.get("obstacles_cleared") is not None
            order = Retrieval.from_record(self.retrieval, objects, flags.get("target_grasped"), cleared=cleared)
        return Outcome(
            episode=episode.episode,
            task=episode.task,
            config=episode.config,
            seed=episode.seed,
            split=episode.split,
            success=not self.error and flags.get("success") is not None,
            success_at_end=not self.error and self.at_end.get("success", False),
            success_v0=not self.error and self.at_end.get("success_v0", False),
            steps=self.steps,
            seconds=round(self.seconds, 4),
            failure_stage=find_failure_stage(flags, self.error, TASKS[episode.task].stages),
            error=escape_controls(self.error),  # may come from the code of the policy
            flags=flags,
            flag_seconds=self.flag_seconds,
            measures=self.measures,
            inference_ms=round(1000 * self.inference_seconds / max(self.steps, 1), 3),
            p_vis=episode.p_vis,
            retrieval=order,
        )


class CameraObservations(NamedTuple):
    """Observations of the cameras: fields of `Observations` with the same names."""

    images: dict[str, NDArray[np.uint8]]
    depths: dict[str, NDArray[Any]]
    intrinsics: dict[str, NDArray[np.float32]]
    camera_in_base: dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class EndConditions:
    """Conditions that end an episode.

    Attributes:
        max_steps: maximum number of policy steps.
        ends_on: names of entries of ``info``, such as ``success`` and ``fail``; the episode ends when one is true.
        max_v0_steps: number of policy steps with success by RoboCAS-v0's rule after which the episode ends; None: the
            rule ends no episode.
    """

    max_steps: int
    ends_on: tuple[str, ...] = ("success", "fail")
    max_v0_steps: int | None = None


def count_checkpoint_steps(control_dt: float) -> int:
    """Return the number of policy steps between checkpoints; ``control_dt``: simulated time per control step, s."""
    return max(1, round(_CHECKPOINT_SECONDS / control_dt))


class EpisodeBatch:
    """Vector environment whose envs run one episode each; the caller chooses the actions.

    Args:
        env: vector environment (`make_vec`, NumPy arrays, no automatic resets) of `PolicyActionWrapper` envs.
        spec: specification of the policy.
        ends: conditions that end an episode.
        control_dt: simulated time per control step, s.
        refill: whether an env can start its next episode while other envs run. False on a GPU, where all envs are
            reset together.

    Attributes:
        obs: last observation of the environment, arrays (N, ...).
        running: by index of the env, the running episode. An episode whose ``error`` is set ends at the next `step`.
    """

    def __init__(self, env: Any, spec: PolicySpec, ends: EndConditions, control_dt: float, *, refill: bool) -> None:
        self.env, self._spec, self._ends, self._dt, self.refill = env, spec, ends, control_dt, refill
        self._checkpoint_steps = count_checkpoint_steps(control_dt)
        self.action_size = CONVENTIONS[spec.convention].size
        self.num_envs: int = env.num_envs
        self.running: dict[int, Rollout] = {}
        self.obs: Any = None
        self._info: dict[str, Any] = {}
        self._flags: list[str] = []  # names of the flags in ``info``
        self._held = np.zeros((0, self.num_envs), dtype=bool)  # (flags, N) whether a flag has held
        self._embed = TextEmbedder() if spec.language == "embedding" else None
        self._calibration: CameraCalibration | None = None  # None before the first reset, or without cameras

    def start_episodes(self, pairs: list[tuple[int, EpisodeSpec]]) -> list[EpisodeSpec]:
        """Reset envs to the initial states of episodes, given as (index of the env, episode).

        Returns the episodes with ``env`` set.
        """
        envs = [env for env, _ in pairs]
        seeds = [start.seed for _, start in pairs]
        starts = [replace(start, env=env) for env, start in pairs]
        self.running.update({start.env: Rollout(start) for start in starts})
        if self.refill:
            self.obs, info = self.env.reset(seed=seeds, options={"env_idx": np.array(envs)})
        else:  # a GPU batch is reset as a whole
            rest = [seeds[0]] * (self.num_envs - len(seeds))
            self.obs, info = self.env.reset(seed=seeds + rest, options={"reconfigure": True})
        self._info = info
        if self._spec.cameras and (self._calibration is None or self._spec.calibration == "true"):
            self._calibration = CameraCalibration(self._spec, self.env.camera_models())
        if not self._flags:
            self._flags = [name for name, value in info.items() if _is_flag(value)]
            self._held = np.zeros((len(self._flags), self.num_envs), dtype=bool)
        self._held[:, envs] = False
        self._record_flags()
        return starts

    def observe(self, envs: list[int], image_requests: NDArray[np.bool_] | None = None) -> Observations:
        """Return the last observations of E envs, one row per env.

        Args:
            envs: indices of the envs.
            image_requests: (E,) bool, whether images of each env are rendered; other images are black. None: all.
        """
        obs, spec, index = self.obs, self._spec, np.array(envs)
        agent = obs["agent"]
        starts = [self.running[env].spec for env in envs]
        texts = [start.instruction if spec.language != "none" else "" for start in starts]
        return Observations(
            envs=index,
            instructions=texts,
            embeddings=self._embed(texts) if self._embed else None,
            robot={name: agent[quantity.name][index] for name, quantity in ROBOT_QUANTITIES.items()},
            state=concatenate_privileged_state(obs["extra"])[index] if spec.state else None,
            simulation=[self._read_simulation_state(env) for env in envs] if spec.simulation_state else None,
            **self.observe_cameras(index, image_requests)._asdict(),
        )

    def observe_cameras(
        self, envs: NDArray[np.int64], image_requests: NDArray[np.bool_] | None = None
    ) -> CameraObservations:
        """Return the present observations of the cameras of the policy in E envs; arguments as in `observe`."""
        spec, requested = self._spec, envs if image_requests is None else envs[image_requests]
        rendered = self.env.render_images(requested) if spec.cameras and len(requested) else {}

        def collect(kind: str, channels: int, dtype: type) -> dict[str, NDArray[Any]]:
            if len(requested) == len(envs):
                return {name: rendered[name][kind] for name in spec.cameras}
            found = {}
            for name, (width, height) in spec.cameras.items():
                found[name] = np.zeros((len(envs), height, width, channels), dtype)
                if len(requested):
                    found[name][image_requests] = rendered[name][kind]
            return found

        calibration = self._calibration
        return CameraObservations(
            images=collect("rgb", 3, np.uint8),
            depths=collect("depth", 1, np.int16) if spec.depth else {},
            intrinsics=calibration.select_intrinsics(envs) if calibration else {},
            camera_in_base=calibration.compute_camera_in_base(envs, self.obs) if calibration else {},
        )

    def step(self, actions: NDArray[np.float32]) -> Iterator[Rollout]:
        """Step all N envs once with actions (N, A) and yield the episodes that end."""
        for env in [env for env, episode in self.running.items() if episode.error]:
            yield self._end_episode(env)
        if not self.running:
            return
        self.obs, _, _, _, self._info = self.env.step(actions)
        for env, episode in self.running.items():
            episode.steps += 1
            episode.actions.append(actions[env].copy())
            if episode.steps % self._checkpoint_steps == 0:
                self._record_checkpoint(episode)
        self._record_flags()
        for env in [env for env, episode in self.running.items() if self._is_over(episode)]:
            yield self._end_episode(env)

    def fail_crashed(self, envs: Sequence[int], error: str) -> Iterator[Rollout]:
        """Yield the running episodes of envs whose worker process crashed, as failed episodes without metrics."""
        for env in envs:
            if env in self.running:
                episode = Rollout(self.running[env].spec, error=error)
                episode.flags = episode.flag_seconds = dict.fromkeys(self._flags)
                episode.measures = dict.fromkeys((*MEASURES, *([_WELDS] if _WELDS in self._info else [])), 0.0)
                yield episode

    def _end_episode(self, env: int) -> Rollout:
        episode, info = self.running.pop(env), self._info
        episode.seconds = self._elapsed_seconds(env)
        for name in self._flags:
            episode.at_end[name] = bool(info[name][env])
            episode.flags.setdefault(name, None)
            episode.flag_seconds.setdefault(name, None)
        episode.measures = {name: round(float(read_metric(info, name)[env]), 4) for name in MEASURES}
        if _WELDS in info:
            episode.measures[_WELDS] = float(info[_WELDS][env])
        if "retrieval" in info:
            episode.retrieval = info["retrieval"][env].copy()
        if episode.steps % self._checkpoint_steps:
            self._record_checkpoint(episode)
        return episode

    def _record_checkpoint(self, episode: Rollout) -> None:
        if CHECKPOINT in self._info:
            episode.checkpoints.append((episode.steps, self._info[CHECKPOINT][episode.spec.env].copy()))

    def _record_flags(self) -> None:
        new = np.array([self._info[name] for name in self._flags]) & ~self._held
        if not new.any():
            return
        for flag, env in np.argwhere(new):
            self._held[flag, env] = True
            if env in self.running:
                episode, name = self.running[env], self._flags[flag]
                episode.flags[name], episode.flag_seconds[name] = episode.steps, round(self._elapsed_seconds(env), 4)

    def _read_simulation_state(self, env: int) -> SimulationState:
        found, episode = self.obs["simulation"], self.running[env]
        values = {
            kind: {name: rows[env : env + 1].copy() for name, rows in of.items()}
            for kind, of in found["values"].items()
        }
        succeeded = episode.flags.get("success") is not None
        return SimulationState(values, float(found["gripper"][env]), episode.steps, succeeded)

    def _elapsed_seconds(self, env: int) -> float:
        return float(self._info["elapsed_steps"][env]) * self._dt

    def _is_over(self, episode: Rollout) -> bool:
        ends, info, env = self._ends, self._info, episode.spec.env
        v0 = ends.max_v0_steps is not None and read_metric(info, "v0_steps")[env] >= ends.max_v0_steps
        return v0 or episode.steps >= ends.max_steps or any(info[name][env] for name in ends.ends_on if name in info)


def run_rollouts(batch: EpisodeBatch, policy: Policy, episodes: Sequence[EpisodeSpec]) -> Iterator[Rollout]:
    """Run episodes with a policy, one per env at a time; yield each episode when it ends, in any order.

    With worker processes, an env starts its next episode when its episode has ended. On a GPU, an env waits until the
    episodes of all envs have ended, because the scenes of all envs are built together.
    """
    waiting, chunks = list(reversed(episodes)), dict[int, list[NDArray[np.floating]]]()
    while waiting or batch.running:
        free = [env for env in range(batch.num_envs) if env not in batch.running]
        if waiting and free and (batch.refill or not batch.running):
            starts = batch.start_episodes([(env, waiting.pop()) for env in free[: len(waiting)]])
            chunks.update({start.env: [] for start in starts})
            with forbid_policy_exit(policy):
                policy.reset(starts)
        _request_actions(batch, policy, chunks)
        actions = np.zeros((batch.num_envs, batch.action_size), np.float32)
        for env, running in batch.running.items():
            if not running.error:
                actions[env] = chunks[env].pop(0)
        yield from batch.step(actions)


def _request_actions(batch: EpisodeBatch, policy: Policy, chunks: dict[int, list[NDArray[np.floating]]]) -> None:
    """Request an action chunk for each running env that has no actions left; add it to ``chunks``.

    If the policy raises `PolicyError`, the ``error`` of the episodes is set.
    """
    running = batch.running
    envs = [env for env in running if not chunks[env]]
    if not envs:
        return
    observations = batch.observe(envs, find_image_requests(policy, np.array(envs)))
    started = time.perf_counter()
    try:
        with forbid_policy_exit(policy):
            actions: Any = np.asarray(policy.act(observations))
    except PolicyError as failed:
        for env in envs if failed.actions is None else failed.reasons:
            running[env].error = failed.reasons.get(env, str(failed))
        if failed.actions is None:
            return
        actions = failed.actions
    seconds = (time.perf_counter() - started) / len(envs)
    where, fix = get_class_name(policy), "Return one row per env: len(observations.envs)."
    new = as_action_chunks(actions, len(envs), batch.action_size, where=where, fix=fix)
    for env, chunk in zip(envs, new, strict=True):
        if not np.isfinite(chunk).all():
            running[env].error = running[env].error or NOT_FINITE
        chunks[env] = list(chunk)
        running[env].inference_seconds += seconds


def _is_flag(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == bool and value.ndim == 1
