"""Policies that know nothing: what they score is what a task gives away."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec

_REACH, _TURN = 0.05, 0.2  # m and rad an action of a random policy goes at most
_CHANGE = 0.1  # probability that it opens or shuts the gripper


class StillPolicy:
    """Stays where it is, gripper open."""

    spec = PolicySpec(reference="tcp", language="none")

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Nothing to begin."""

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """(E, 7) no motion."""
        return np.tile(np.array([0, 0, 0, 0, 0, 0, 1.0]), (len(observations.envs), 1))


class RandomPolicy:
    """Goes anywhere; each episode from its own seed, whatever is played beside it."""

    spec = PolicySpec(reference="tcp", language="none")

    def __init__(self) -> None:
        self._draws: dict[int, np.random.Generator] = {}
        self._open: dict[int, bool] = {}

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Begin anew with the episodes' seeds."""
        for start in starts:
            self._draws[start.env], self._open[start.env] = np.random.default_rng([start.seed, start.episode]), True

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """(E, 7) uniform motions."""
        return np.stack([self._draw(env) for env in observations.envs.tolist()])

    def _draw(self, env: int) -> NDArray[np.floating]:
        rng = self._draws[env]
        self._open[env] ^= bool(rng.random() < _CHANGE)
        return np.append(rng.uniform(-1, 1, 6) * np.repeat([_REACH, _TURN], 3), float(self._open[env]))
