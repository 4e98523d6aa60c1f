"""Run episodes of a protocol for an external evaluation loop, which resets and steps."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.datasets.writing.render import require_renderer
from robocas_ms3.evaluation.outcomes import Outcome
from robocas_ms3.evaluation.policy import Observations, PolicySpec
from robocas_ms3.evaluation.protocol import Episode, LoadedProtocol
from robocas_ms3.evaluation.rollout import NOT_FINITE, EpisodeBatch, Rules, as_chunks
from robocas_ms3.evaluation.run import Settings, about
from robocas_ms3.evaluation.stage import make_env, object_ids, rate_of, start_of
from robocas_ms3.tasks.vector.backend import choose_backend

ONE_ENV = Settings(num_envs=1, backend="processes")


@dataclass(frozen=True)
class ExternalPolicy:
    """The policy of an external loop, as far as results describe it.

    Attributes:
        spec: what it sees, and what its actions mean.
    """

    spec: PolicySpec


class DrivenEpisodes:
    """Runs one episode of a protocol in each of several envs; the caller chooses the actions.

    Steps, ends and measures are those of ``robocas eval``: both use `EpisodeBatch`. The environment stays open while
    the configuration of the episodes is the same.

    Args:
        protocol: whose episodes.
        spec: what the policy sees, and what its actions mean.
        settings: number of envs, and where they run.
        name: of the policy, for `about`.

    Attributes:
        outcomes: by env, the outcome of each episode that has ended since the last reset.
        about: what a result says about the run (`run.about`).

    Raises:
        EvaluationError: the policy does not fit the protocol, or the object pack is another.
        DatasetError: the policy uses cameras, and there is no render device.
    """

    def __init__(
        self, protocol: LoadedProtocol, spec: PolicySpec, settings: Settings = ONE_ENV, name: str = ""
    ) -> None:
        protocol.rules.refuse(spec)
        if spec.cameras:
            require_renderer()
        self.protocol, self.spec, self.settings = protocol, spec, settings
        self.rate = rate_of(protocol, spec)
        policy: Any = ExternalPolicy(spec)
        self.about: dict[str, Any] = about(protocol, policy, name, settings)
        self.outcomes: dict[int, Outcome] = {}
        self._episodes: list[Episode] = []
        self._env: Any = None
        self._batch: EpisodeBatch | None = None
        self._config = ""
        self._observed = 0.0  # clock time at which the caller received the last observation, s

    @property
    def obs(self) -> dict[str, Any]:
        """Last observation of the environment, arrays (N, ...)."""
        assert self._batch is not None
        return self._batch.obs

    def max_steps(self, task: str) -> int:
        """Return the maximum number of policy steps per episode of a task."""
        steps = self.protocol.rules.steps(task, self.rate)
        assert steps is not None  # `load_protocol` checks it
        return steps

    def reset(self, numbers: Sequence[int]) -> Observations:
        """Start an episode in each env. Episodes that still run are dropped, without an outcome.

        Args:
            numbers: of the episodes in the protocol's list, one per env, all of one configuration.

        Raises:
            EvaluationError: there is no such episode, or the configurations differ.
        """
        where, known = self.protocol.rules.name, self.protocol.episodes
        for number in numbers:
            if not 0 <= number < len(known):
                raise EvaluationError("no such episode", where=where, expected=f"0 to {len(known) - 1}", found=number)
        episodes = [known[number] for number in numbers]
        if len(episodes) != self.settings.num_envs:
            raise EvaluationError(
                "wrong number of episodes", where=where, expected=self.settings.num_envs, found=len(episodes)
            )
        configs = list(dict.fromkeys(episode.config for episode in episodes))
        if len(configs) > 1:
            raise EvaluationError(
                "episodes of several configurations in one batch", where=where, expected="one", found=", ".join(configs)
            )
        self._episodes, self.outcomes = episodes, {}
        batch = self._open(episodes[0])
        try:
            batch.start([(env, start_of(self.protocol, episode)) for env, episode in enumerate(episodes)])
        except Exception:
            self.close()
            raise
        return self._observe(batch)

    def step(self, actions: ArrayLike) -> Observations | None:
        """Step the running episodes.

        Args:
            actions: (N, A), or chunks (N, H, A), of which every step is executed. Rows of envs whose episode has ended
                have no effect. An episode whose actions are not finite ends with an error.

        Returns:
            What the envs with a running episode show; None if all episodes have ended.

        Raises:
            EvaluationError: no episode runs, or the actions have another shape.
            WorkerDied: a process of the environment died.
        """
        batch = self._batch
        if batch is None or not batch.running:
            raise EvaluationError("no episode is running", fix="Call reset first.")
        chunks = as_chunks(np.asarray(actions, np.float32), batch.num_envs, batch.size, where="step")
        spent = (time.perf_counter() - self._observed) / len(batch.running)
        for env, played in batch.running.items():
            played.inference_seconds += spent
            if not np.isfinite(chunks[env]).all():
                played.error = NOT_FINITE
        try:
            for step in range(chunks.shape[1]):
                self._advance(batch, chunks[:, step])
                if not batch.running:
                    return None
        except Exception:
            self.close()
            raise
        return self._observe(batch)

    def close(self) -> None:
        """Close the environment. A later reset opens another one."""
        env, self._env, self._batch, self._config = self._env, None, None, ""
        if env is not None:
            env.close()

    def _advance(self, batch: EpisodeBatch, actions: np.ndarray) -> None:
        rows = np.zeros((batch.num_envs, batch.size), np.float32)
        live = [env for env, played in batch.running.items() if not played.error]
        rows[live] = actions[live]
        for played in batch.step(rows):
            episode = self._episodes[played.start.env]
            self.outcomes[played.start.env] = Outcome.of(played, episode, object_ids(self.protocol, episode))

    def _observe(self, batch: EpisodeBatch) -> Observations:
        seen = batch.observe(sorted(batch.running))
        self._observed = time.perf_counter()
        return seen

    def _open(self, episode: Episode) -> EpisodeBatch:
        """Return the batch of an episode's configuration, in an environment that is opened where needed."""
        if self._batch is not None and self._config == episode.config:
            return self._batch
        self.close()
        settings, rules = self.settings, self.protocol.rules
        runs = {name: getattr(settings, name) for name in ("backend", "workers", "weld", "limits")}
        self._env = make_env(self.protocol, self.spec, episode, settings.num_envs, **runs)
        ends = Rules(self.max_steps(episode.task), tuple(rules.ends_on), rules.max_v0_steps)
        refill = choose_backend(settings.backend) != "gpu"
        self._batch = EpisodeBatch(self._env, self.spec, ends, 1 / self.rate, refill=refill)
        self._config = episode.config
        return self._batch
