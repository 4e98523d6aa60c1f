"""A policy plays a list of episodes in several envs at a time; one loop, whatever the backend."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.errors import EvaluationError, PolicyFailed
from robocas_ms3.evaluation.actions import CONVENTIONS
from robocas_ms3.evaluation.policy import Observations, Policy, Start, policy_code, privileged
from robocas_ms3.evaluation.tracking import MEASURES, summed
from robocas_ms3.language.embed import TextEmbedder

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

    start: Start
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


class Rollouts:
    """Plays episodes in a vector environment (`make_vec`, NumPy arrays, no resets of its own).

    In processes an env that is done begins the next episode at once; in a GPU's batch, where objects are built for all
    envs together, it waits, masked, until all are done. What comes of an episode follows from its seed and the policy's
    actions alone.

    Args:
        env: whose envs take actions of the policy's convention (`stepping.PolicyStepping`).
        policy: that acts.
        rules: when an episode ends.
        control_dt: s of the scene a control step takes.
        refill: whether envs may begin anew while others go on.
    """

    def __init__(self, env: Any, policy: Policy, rules: Rules, control_dt: float, *, refill: bool) -> None:
        self._env, self._policy, self._rules, self._dt, self._refill = env, policy, rules, control_dt, refill
        self._size = CONVENTIONS[policy.wants.convention].size
        self._count: int = env.num_envs
        self._playing: dict[int, Rollout] = {}
        self._chunks: dict[int, list[NDArray[np.floating]]] = {}
        self._obs: Any = None
        self._info: dict[str, Any] = {}
        self._flags: list[str] = []  # names of an info's flags
        self._held = np.zeros((0, self._count), dtype=bool)  # by flag and env, whether it has held in its episode
        self._embed = TextEmbedder() if policy.wants.language == "embedding" else None

    def play(self, episodes: Sequence[Start]) -> Iterator[Rollout]:
        """Play episodes; each is given as it ends, in any order. Their ``env`` is set here."""
        waiting = list(reversed(episodes))
        while waiting or self._playing:
            free = [env for env in range(self._count) if env not in self._playing]
            if waiting and free and (self._refill or not self._playing):
                self._begin([(env, waiting.pop()) for env in free[: len(waiting)]])
            yield from self._step()

    def lost(self, envs: Sequence[int], why: str) -> Iterator[Rollout]:
        """Episodes under way in some envs that are no more: nothing is known of what happened in them."""
        for env in envs:
            if env in self._playing:
                played = Rollout(self._playing[env].start, error=why)
                played.flags = played.flag_seconds = dict.fromkeys(self._flags)
                played.measures = dict.fromkeys((*MEASURES, *([_WELDS] if _WELDS in self._info else [])), 0.0)
                yield played

    def _begin(self, pairs: list[tuple[int, Start]]) -> None:
        envs = [env for env, _ in pairs]
        seeds = [start.seed for _, start in pairs]
        starts = [Start(**{**vars(start), "env": env}) for env, start in pairs]
        for start in starts:
            self._playing[start.env], self._chunks[start.env] = Rollout(start), []
        if self._refill:
            self._obs, info = self._env.reset(seed=seeds, options={"env_idx": np.array(envs)})
        else:  # a batch is reset as a whole, with the objects of these seeds
            rest = [seeds[0]] * (self._count - len(seeds))
            self._obs, info = self._env.reset(seed=seeds + rest, options={"reconfigure": True})
        self._info = info
        if not self._flags:
            self._flags = [name for name, value in info.items() if _is_flag(value)]
            self._held = np.zeros((len(self._flags), self._count), dtype=bool)
        self._held[:, envs] = False
        self._note()
        with policy_code(self._policy):
            self._policy.reset(starts)

    def _step(self) -> Iterator[Rollout]:
        self._ask()
        for env, played in list(self._playing.items()):
            if played.error:
                yield self._end(env)
        if not self._playing:
            return
        actions = np.zeros((self._count, self._size), np.float32)  # of envs that are done; nobody looks
        for env in self._playing:
            actions[env] = self._chunks[env].pop(0)
        self._obs, _, _, _, self._info = self._env.step(actions)
        for played in self._playing.values():
            played.steps += 1
        self._note()
        for env in [env for env, played in self._playing.items() if self._is_over(played)]:
            yield self._end(env)

    def _end(self, env: int) -> Rollout:
        played, info = self._playing.pop(env), self._info
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

    def _ask(self) -> None:
        """See that every env that plays has an action."""
        envs = [env for env in self._playing if not self._chunks[env]]
        if not envs:
            return
        seen = self._observed(envs)
        begun = time.perf_counter()
        try:
            with policy_code(self._policy):
                acted: Any = self._policy.act(seen)
                actions = np.asarray(acted, np.float32)
        except PolicyFailed as failed:
            acted = failed.actions
            for env in envs if acted is None else failed.reasons:
                self._playing[env].error = failed.reasons.get(env, str(failed))
            if acted is None:
                return
            actions = np.asarray(acted, np.float32)
        spent = (time.perf_counter() - begun) / len(envs)
        chunks = actions[:, None] if actions.ndim == 2 else actions
        if chunks.ndim != 3 or chunks.shape[0] != len(envs) or chunks.shape[1] < 1 or chunks.shape[2] != self._size:
            raise EvaluationError(
                "actions don't fit",
                where=type(self._policy).__name__,
                expected=f"({len(envs)}, {self._size}) or ({len(envs)}, chunk, {self._size})",
                found=actions.shape,
            )
        every = self._policy.wants.look_every
        if chunks.shape[1] > 1 and chunks.shape[1] % every:
            what = "it would be asked for chunks without a look at pictures"
            raise EvaluationError(
                what, where=type(self._policy).__name__, expected=f"a multiple of {every} steps", found=chunks.shape[1]
            )
        finite = np.isfinite(chunks).all((1, 2))
        for env, chunk, good in zip(envs, chunks, finite, strict=True):
            if not good:
                self._playing[env].error = self._playing[env].error or "the policy's action is not finite"
            self._chunks[env] = list(chunk)
            self._playing[env].inference_seconds += spent

    def _observed(self, envs: list[int]) -> Observations:
        obs, wants, index = self._obs, self._policy.wants, np.array(envs)
        agent, cameras = obs["agent"], obs.get("sensor_data", {})
        playing = [self._playing[env].start for env in envs]
        texts = [start.instruction if wants.language != "none" else "" for start in playing]
        return Observations(
            envs=index,
            instructions=texts,
            embeddings=self._embed(texts) if self._embed else None,
            images={name: cameras[name]["rgb"][index] for name in wants.cameras},
            depths={name: cameras[name]["depth"][index] for name in wants.cameras} if wants.depth else {},
            qpos=agent["qpos"][index],
            tcp_in_base=agent["tcp_in_arm_base"][index],
            gripper_width=agent["gripper_width"][index],
            state=privileged(obs["extra"])[index] if wants.state else None,
        )

    def _note(self) -> None:
        """Write down which flags hold for the first time."""
        new = np.array([self._info[name] for name in self._flags]) & ~self._held
        if not new.any():
            return
        for flag, env in np.argwhere(new):
            self._held[flag, env] = True
            if env in self._playing:
                played, name = self._playing[env], self._flags[flag]
                played.flags[name], played.flag_seconds[name] = played.steps, round(self._seconds(env), 4)

    def _seconds(self, env: int) -> float:
        return float(self._info["elapsed_steps"][env]) * self._dt

    def _is_over(self, played: Rollout) -> bool:
        rules, info, env = self._rules, self._info, played.start.env
        v0 = rules.max_v0_steps is not None and summed(info, "v0_steps")[env] >= rules.max_v0_steps
        return v0 or played.steps >= rules.max_steps or any(info[name][env] for name in rules.ends_on if name in info)


def _is_flag(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == bool and value.ndim == 1
