"""Replay of the stored actions of a result: a policy, and an environment that returns to recorded checkpoints."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import PolicyError
from robocas_ms3.evaluation.policy import CONVENTIONS, EpisodeSpec, Observations, PolicySpec
from robocas_ms3.evaluation.results.checkpoints import StateDeviation
from robocas_ms3.evaluation.results.outcomes import Checkpoints
from robocas_ms3.evaluation.results.result_files import Result

RESTORE_TOLERANCE = 0.005
"""Deviation from a checkpoint in m or rad up to which the state is not restored."""
NO_ACTIONS_LEFT = "the stored actions end before the episode"


class StoredActionsPolicy:
    """Policy that sends the stored actions of a result. It observes nothing.

    An episode that needs more actions ends with an error.

    Args:
        result: the result.
        repeats: how often the last action of an episode is repeated before this error. The last action before a
            recorded error is not repeated.

    Attributes:
        progress: by index of the env, number of the episode and number of its actions up to the last call of `act`, for
            the envs of this call.
    """

    def __init__(self, result: Result, repeats: int = 0) -> None:
        self._result, self._repeats, values = result, repeats, result.run.policy.spec
        motion = {name: values[name] for name in ("convention", "reference", "rate_hz") if name in values}
        self.spec = PolicySpec(**motion, language="none")
        self._actions: dict[int, tuple[int, NDArray[np.float32]]] = {}  # by env: episode and its actions
        self._counts: dict[int, int] = {}  # by env
        self.progress: dict[int, tuple[int, int]] = {}

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        for one in episodes:
            actions = self._result.read_actions(one.episode)
            if not self._result.outcomes[one.episode].error:
                actions = np.concatenate([actions, np.repeat(actions[-1:], self._repeats, axis=0)])
            self._actions[one.env], self._counts[one.env] = (one.episode, actions), 0

    def act(self, observations: Observations) -> NDArray[np.float32]:
        """Return one action per env (E, A)."""
        envs = observations.envs.tolist()
        found = np.zeros((len(envs), CONVENTIONS[self.spec.convention].size), np.float32)
        self.progress, missing = {}, {}
        for row, env in enumerate(envs):
            (episode, actions), count = self._actions[env], self._counts[env]
            if count == len(actions):
                missing[env] = NO_ACTIONS_LEFT
                continue
            found[row], self._counts[env] = actions[count], count + 1
            self.progress[env] = episode, count + 1
        if missing:
            raise PolicyError(missing, found)
        return found


@dataclass(frozen=True)
class CheckpointLog:
    """Comparison of replays with the recorded checkpoints.

    Attributes:
        deviations: by number of the episode, how far the state was from each checkpoint.
        lost_stages: by number of the episode, the stages that the replay had reached, but not the checkpoint to which
            it returned, each with the policy step and the control step at which it was reached again; None: it was
            not.
    """

    deviations: dict[int, list[StateDeviation]] = field(default_factory=dict)
    lost_stages: dict[int, dict[str, tuple[int, int] | None]] = field(default_factory=dict)


class CheckpointEnv:
    """Vector environment whose envs return to a recorded state if they are far from it, at each checkpoint.

    Args:
        env: vector environment of `PolicyActionWrapper` envs in processes.
        policy: policy that chooses the actions.
        result: the result, with checkpoints.
        log: gets how far each state was from its checkpoint.
    """

    def __init__(self, env: Any, policy: StoredActionsPolicy, result: Result, log: CheckpointLog) -> None:
        self._env, self._policy, self._result, self.num_envs = env, policy, result, env.num_envs
        self._log = log
        self._checkpoints: dict[int, Checkpoints] = {}  # by episode

    def reset(self, **kwargs: Any) -> Any:
        return self._env.reset(**kwargs)

    def step(self, actions: Any) -> Any:
        results, calls = self._env.step(actions), {}
        for env, (episode, step) in self._policy.progress.items():
            for stage, reached_again in (lost := self._log.lost_stages.setdefault(episode, {})).items():
                if reached_again is None and results[-1][stage][env]:
                    lost[stage] = step, int(results[-1]["elapsed_steps"][env])
            if episode not in self._checkpoints:
                self._checkpoints[episode] = self._result.read_checkpoints(episode)
            steps, states = self._checkpoints[episode]
            for row in np.flatnonzero(steps == step):
                # the last state is only compared, so that a success after it comes from the simulation
                calls[env] = states[row], math.inf if step == steps[-1] else RESTORE_TOLERANCE
        if calls:
            for env, (deviation, stages) in self._env.call_each("restore_checkpoint", calls).items():
                episode = self._policy.progress[env][0]
                self._log.deviations.setdefault(episode, []).append(deviation)
                self._log.lost_stages[episode].update(dict.fromkeys(stages))
        return results

    def close(self) -> None:
        self._env.close()
