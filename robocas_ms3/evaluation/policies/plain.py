"""Policies that ignore the observations. Their success rate is the success rate by chance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec

_REACH, _TURN = 0.05, 0.2  # largest motion per random action, m and rad
_CHANGE = 0.1  # probability that a random action opens or closes the gripper


class NoopPolicy:
    """Policy that keeps the arm still and the gripper open."""

    spec = PolicySpec(reference="tcp", language="none")

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        pass

    def act(self, observations: Observations) -> NDArray[np.floating]:
        return np.tile(np.array([0, 0, 0, 0, 0, 0, 1.0]), (len(observations.envs), 1))


class RandomPolicy:
    """Policy with random actions, drawn from a generator that is seeded per episode.

    Each translation component is uniform in -5..5 cm and each Euler angle in -0.2..0.2 rad. An action opens or closes
    the gripper with probability 0.1.
    """

    spec = PolicySpec(reference="tcp", language="none")

    def __init__(self) -> None:
        self._generators: dict[int, np.random.Generator] = {}
        self._open: dict[int, bool] = {}

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        for episode in episodes:
            self._generators[episode.env] = np.random.default_rng([episode.seed, episode.episode])
            self._open[episode.env] = True

    def act(self, observations: Observations) -> NDArray[np.floating]:
        return np.stack([self._draw_action(env) for env in observations.envs.tolist()])

    def _draw_action(self, env: int) -> NDArray[np.floating]:
        rng = self._generators[env]
        self._open[env] ^= bool(rng.random() < _CHANGE)
        return np.append(rng.uniform(-1, 1, 6) * np.repeat([_REACH, _TURN], 3), float(self._open[env]))
