"""A policy plays a list of episodes in several envs at a time; one loop, whatever the backend."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError, PolicyFailed
from robocas_ms3.evaluation.actions import CONVENTIONS
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, Policy, PolicySpec, policy_code, privileged
from robocas_ms3.evaluation.tracking import MEASURES, summed
from robocas_ms3.scenes.language.embed import TextEmbedder

NOT_FINITE = "the policy's action is not finite"
_WELDS = "welds"  # of `weld`, where there is one


@dataclass
class Rollout:
    """What came of an episode.

    Attributes:
        start: which one.
        steps: policy steps.
        seconds: of the scene's time.
        flags: by name of a stage or rule, the policy step after which it first held, from 1 on; None: never.
        flag_seconds: the same in the scene's seconds.
        at_end: whether it held after the last step.
        measures: sums and extremes (`tracking`).
        retrieval: (K, 3) of search, see `retrieval.Retrieval.read`.
        inference_seconds: clock time the policy took, its share of each batch.
        error: why it was broken off, as by a policy that failed; empty: it was not.
    """

    start: EpisodeSpec
    steps: int = 0
    seconds: float = 0.0
    flags: dict[str, int | None] = field(default_factory=dict)
    flag_seconds: dict[str, float | None] = field(default_factory=dict)
    at_end: dict[str, bool] = field(default_factory=dict)
    measures: dict[str, float] = field(default_factory=dict)
    retrieval: NDArray[np.integer] | None = None
    inference_seconds: float = 0.0
    error: str = ""


@dataclass(frozen=True)
class Rules:
    """When an episode ends.

    Attributes:
        max_steps: policy steps.
        ends_on: flags at which it ends at once, such as ``success`` and ``fail``.
        max_v0_steps: it ends when upstream's success has held that often; None: that ends nothing.
    """

    max_steps: int
    ends_on: tuple[str, ...] = ("success", "fail")
    max_v0_steps: int | None = None


class EpisodeBatch:
    """Runs one episode in each of several envs; the caller chooses the action of every step.

    The result of an episode depends on its seed and its actions only.

    Args:
        env: vector environment (`make_vec`, NumPy arrays, no automatic resets) whose envs take actions of the policy's
            convention (`stepping.PolicyStepping`).
        spec: what the policy sees, and what its actions mean.
        rules: when an episode ends.
        control_dt: simulated time of a control step, s.
        refill: whether an env can be reset while others run. In a GPU's batch all envs are reset together.

    Attributes:
        obs: last observation of the environment, arrays (N, ...).
        running: by env, the episode that it runs. An entry with an ``error`` ends at the next step.
        size: numbers of an action.
    """

    def __init__(self, env: Any, spec: PolicySpec, rules: Rules, control_dt: float, *, refill: bool) -> None:
        self._env, self._spec, self._rules, self._dt, self.refill = env, spec, rules, control_dt, refill
        self.size = CONVENTIONS[spec.convention].size
        self.num_envs: int = env.num_envs
        self.running: dict[int, Rollout] = {}
        self.obs: Any = None
        self._info: dict[str, Any] = {}
        self._flags: list[str] = []  # names of an info's flags
        self._held = np.zeros((0, self.num_envs), dtype=bool)  # by flag and env, whether it has held in its episode
        self._embed = TextEmbedder() if spec.language == "embedding" else None

    def start(self, pairs: list[tuple[int, EpisodeSpec]]) -> list[EpisodeSpec]:
        """Reset envs to the first state of episodes.

        Args:
            pairs: an env and its episode. Where envs can't be reset one by one, no other episode may run.

        Returns:
            The episodes, with ``env`` set.
        """
        envs = [env for env, _ in pairs]
        seeds = [start.seed for _, start in pairs]
        starts = [replace(start, env=env) for env, start in pairs]
        self.running.update({start.env: Rollout(start) for start in starts})
        if self.refill:
            self.obs, info = self._env.reset(seed=seeds, options={"env_idx": np.array(envs)})
        else:  # a batch is reset as a whole, with the objects of these seeds
            rest = [seeds[0]] * (self.num_envs - len(seeds))
            self.obs, info = self._env.reset(seed=seeds + rest, options={"reconfigure": True})
        self._info = info
        if not self._flags:
            self._flags = [name for name, value in info.items() if _is_flag(value)]
            self._held = np.zeros((len(self._flags), self.num_envs), dtype=bool)
        self._held[:, envs] = False
        self._note()
        return starts

    def observe(self, envs: list[int]) -> Observations:
        """Return what the policy sees of some running envs."""
        obs, spec, index = self.obs, self._spec, np.array(envs)
        agent, cameras = obs["agent"], obs.get("sensor_data", {})
        starts = [self.running[env].start for env in envs]
        texts = [start.instruction if spec.language != "none" else "" for start in starts]
        return Observations(
            envs=index,
            instructions=texts,
            embeddings=self._embed(texts) if self._embed else None,
            images={name: cameras[name]["rgb"][index] for name in spec.cameras},
            depths={name: cameras[name]["depth"][index] for name in spec.cameras} if spec.depth else {},
            qpos=agent["qpos"][index],
            tcp_in_base=agent["tcp_in_arm_base"][index],
            gripper_width=agent["gripper_width"][index],
            state=privileged(obs["extra"])[index] if spec.state else None,
        )

    def step(self, actions: NDArray[np.float32]) -> Iterator[Rollout]:
        """Step all envs once, and yield the episodes that end.

        Args:
            actions: (N, A); rows of envs without an episode have no effect on results.
        """
        for env in [env for env, played in self.running.items() if played.error]:
            yield self._end(env)
        if not self.running:
            return
        self.obs, _, _, _, self._info = self._env.step(actions)
        for played in self.running.values():
            played.steps += 1
        self._note()
        for env in [env for env, played in self.running.items() if self._is_over(played)]:
            yield self._end(env)

    def lost(self, envs: Sequence[int], why: str) -> Iterator[Rollout]:
        """Yield the running episodes of envs whose process died, as failures without measures."""
        for env in envs:
            if env in self.running:
                played = Rollout(self.running[env].start, error=why)
                played.flags = played.flag_seconds = dict.fromkeys(self._flags)
                played.measures = dict.fromkeys((*MEASURES, *([_WELDS] if _WELDS in self._info else [])), 0.0)
                yield played

    def _end(self, env: int) -> Rollout:
        played, info = self.running.pop(env), self._info
        played.seconds = self._seconds(env)
        for name in self._flags:
            played.at_end[name] = bool(info[name][env])
            played.flags.setdefault(name, None)
            played.flag_seconds.setdefault(name, None)
        played.measures = {name: round(float(summed(info, name)[env]), 4) for name in MEASURES}
        if _WELDS in info:
            played.measures[_WELDS] = float(info[_WELDS][env])
        if "retrieval" in info:
            played.retrieval = info["retrieval"][env].copy()
        return played

    def _note(self) -> None:
        """Write down which flags hold for the first time."""
        new = np.array([self._info[name] for name in self._flags]) & ~self._held
        if not new.any():
            return
        for flag, env in np.argwhere(new):
            self._held[flag, env] = True
            if env in self.running:
                played, name = self.running[env], self._flags[flag]
                played.flags[name], played.flag_seconds[name] = played.steps, round(self._seconds(env), 4)

    def _seconds(self, env: int) -> float:
        return float(self._info["elapsed_steps"][env]) * self._dt

    def _is_over(self, played: Rollout) -> bool:
        rules, info, env = self._rules, self._info, played.start.env
        v0 = rules.max_v0_steps is not None and summed(info, "v0_steps")[env] >= rules.max_v0_steps
        return v0 or played.steps >= rules.max_steps or any(info[name][env] for name in rules.ends_on if name in info)


class Rollouts:
    """Plays episodes in a vector environment with a policy.

    In processes an env that is done begins the next episode at once; in a GPU's batch, where objects are built for all
    envs together, it waits, masked, until all are done.

    Args:
        env: see `EpisodeBatch`.
        policy: that acts.
        rules: when an episode ends.
        control_dt: simulated time of a control step, s.
        refill: see `EpisodeBatch`.
    """

    def __init__(self, env: Any, policy: Policy, rules: Rules, control_dt: float, *, refill: bool) -> None:
        self._batch = EpisodeBatch(env, policy.spec, rules, control_dt, refill=refill)
        self._policy = policy
        self._chunks: dict[int, list[NDArray[np.floating]]] = {}
        self.lost = self._batch.lost

    def play(self, episodes: Sequence[EpisodeSpec]) -> Iterator[Rollout]:
        """Play episodes; each is given as it ends, in any order. Their ``env`` is set here."""
        waiting, batch = list(reversed(episodes)), self._batch
        while waiting or batch.running:
            free = [env for env in range(batch.num_envs) if env not in batch.running]
            if waiting and free and (batch.refill or not batch.running):
                starts = batch.start([(env, waiting.pop()) for env in free[: len(waiting)]])
                self._chunks.update({start.env: [] for start in starts})
                with policy_code(self._policy):
                    self._policy.reset(starts)
            self._ask()
            actions = np.zeros((batch.num_envs, batch.size), np.float32)
            for env, played in batch.running.items():
                if not played.error:
                    actions[env] = self._chunks[env].pop(0)
            yield from batch.step(actions)

    def _ask(self) -> None:
        """See that every env that plays has an action."""
        running = self._batch.running
        envs = [env for env in running if not self._chunks[env]]
        if not envs:
            return
        seen = self._batch.observe(envs)
        begun = time.perf_counter()
        try:
            with policy_code(self._policy):
                acted: Any = self._policy.act(seen)
                actions = np.asarray(acted, np.float32)
        except PolicyFailed as failed:
            acted = failed.actions
            for env in envs if acted is None else failed.reasons:
                running[env].error = failed.reasons.get(env, str(failed))
            if acted is None:
                return
            actions = np.asarray(acted, np.float32)
        spent = (time.perf_counter() - begun) / len(envs)
        chunks = as_chunks(actions, len(envs), self._batch.size, where=type(self._policy).__name__)
        every = self._policy.spec.look_every
        if chunks.shape[1] > 1 and chunks.shape[1] % every:
            what = "it would be asked for chunks without a look at pictures"
            raise EvaluationError(
                what, where=type(self._policy).__name__, expected=f"a multiple of {every} steps", found=chunks.shape[1]
            )
        for env, chunk in zip(envs, chunks, strict=True):
            if not np.isfinite(chunk).all():
                running[env].error = running[env].error or NOT_FINITE
            self._chunks[env] = list(chunk)
            running[env].inference_seconds += spent


def as_chunks(actions: NDArray[np.float32], count: int, size: int, *, where: str) -> NDArray[np.float32]:
    """Return the actions of ``count`` envs as chunks (E, H, A).

    Args:
        actions: (E, A), or chunks (E, H, A).
        count: E.
        size: A.
        where: who gave them.

    Raises:
        EvaluationError: they have another shape.
    """
    chunks = actions[:, None] if actions.ndim == 2 else actions
    if chunks.ndim != 3 or chunks.shape[0] != count or chunks.shape[1] < 1 or chunks.shape[2] != size:
        expected = f"({count}, {size}) or ({count}, chunk, {size})"
        raise EvaluationError("actions don't fit", where=where, expected=expected, found=actions.shape)
    return chunks


def _is_flag(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == bool and value.ndim == 1
