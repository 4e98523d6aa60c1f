"""Policies that follow a track: poses of the TCP, or joint targets, that were found or recorded before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.evaluation.policy import Observations


@dataclass(frozen=True)
class Track:
    """What to do in an episode: an action a policy step.

    Attributes:
        actions: (S, A) of the policy's convention.
    """

    actions: NDArray[np.floating]


class Followers:
    """Hands out tracks' actions, env by env; where a track ends, or there is none, the last action holds still.

    Args:
        still: (A,) the action where there is no track at all.
        motions: whether actions are motions, of which all but the gripper's command is over at the end.
    """

    def __init__(self, still: NDArray[np.floating], *, motions: bool) -> None:
        self._still, self._motions = still, motions
        self._left: dict[int, list[NDArray[np.floating]]] = {}
        self._last: dict[int, NDArray[np.floating]] = {}

    def begin(self, env: int, track: Track | None) -> None:
        """Set out on an episode's track in an env."""
        self._left[env] = list(track.actions) if track is not None else []
        self._last[env] = self._still

    def next(self, observations: Observations) -> NDArray[np.floating]:
        """(E, A) actions."""
        return np.stack([self._one(env) for env in observations.envs.tolist()])

    def _one(self, env: int) -> NDArray[np.floating]:
        if self._left[env]:
            action = self._left[env].pop(0)
            self._last[env] = action
            return action
        last = self._last[env]
        return np.append(np.zeros(len(last) - 1), last[-1]) if self._motions else last
