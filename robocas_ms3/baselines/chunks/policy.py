"""Acts by chunks of poses: follows each for some steps, and goes where several predictions agree to be next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.chunks.poses import decode
from robocas_ms3.core.poses import Array, from_wxyz
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec

_EMPTY = 0.004
"""m; between fingers that hold nothing."""

Predict = Callable[[Observations, int], NDArray[np.floating]]


class ChunkPolicy:
    """Speaks RoboCAS' seven numbers, relative to where the TCP is.

    A chunk is followed for some steps before the next one. Who sees pictures and no speeds takes every rest for the
    beginning of a motion, which is slow: asked at every step, it would creep, and put off closing the gripper for ever.
    A step's pose is the mean of what was predicted for it, weighted by exp(-fade age) (Zhao et al. 2023 weigh the
    oldest most; at 5 Hz the newest knows more).

    One reflex is not learned, and off unless asked for: an empty fist that has not moved since the last chunk opens.
    Whoever missed looks like one who pushes with a closed hand, and would wait for ever.

    Args:
        spec: what it is to be shown; of pictures those that a new chunk begins with.
        predict: (K, 10) chunk of what one env shows, of observations and its row, see `chunks`.
        play: steps of a chunk before the next one, up to K.
        fade: how fast older predictions lose weight, a step.
        about: what a result says of it besides.
        reopen: m that an empty fist moves less than in a chunk, to be opened for the next one; 0: never.
    """

    def __init__(
        self, spec: PolicySpec, predict: Predict, play: int, fade: float, about: dict[str, Any], reopen: float = 0.0
    ) -> None:
        self.spec, self._predict, self._about = replace(spec, look_every=play), predict, about
        self._play, self._fade, self._reopen = play, fade, reopen
        self._plans: dict[int, list[_Plan]] = {}  # by env, newest first
        self._looked_from: dict[int, Array] = {}  # by env, (3,) where the TCP was in the arm's base

    def describe(self) -> dict[str, Any]:
        """What a result says of it besides."""
        return self._about

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Forget what was planned in these envs."""
        for start in starts:
            self._plans[start.env] = []
            self._looked_from.pop(start.env, None)

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """(E, 7) motions."""
        tcp = from_wxyz(observations.tcp_in_base)
        envs = observations.envs.tolist()
        for env in envs:
            self._plans[env] = [plan.older() for plan in self._plans[env] if plan.age + 1 < len(plan.poses)]
        for row, env in enumerate(envs):
            if not self._plans[env] or self._plans[env][0].age >= self._play:
                chunk = self._predict(observations, row)  # by itself: in a batch it would depend on the others' bits
                poses, opened = decode(chunk, tcp[row])
                self._plans[env].insert(0, _Plan(poses, opened))
                if self._waits(env, tcp[row, :3, 3], float(observations.gripper_width.reshape(-1)[row])):
                    self._plans[env] = [plan.open() for plan in self._plans[env]]  # else older ones could outvote it
        return np.stack([self._next(self._plans[env], here) for env, here in zip(envs, tcp, strict=True)])

    def _waits(self, env: int, here: Array, width: float) -> bool:
        """Whether an empty fist is where it was when the last chunk began; remembers where it is."""
        before = self._looked_from.get(env)
        self._looked_from[env] = here.copy()
        return width < _EMPTY and before is not None and bool(np.linalg.norm(here - before) < self._reopen)

    def _next(self, plans: list[_Plan], here: Array) -> NDArray[np.float64]:
        weights = np.exp(-self._fade * np.array([plan.age for plan in plans]))
        weights /= weights.sum()
        poses = np.stack([plan.poses[plan.age] for plan in plans])
        opened = float(weights @ [plan.opened[plan.age] for plan in plans])
        turn = Rotation.from_matrix(poses[:, :3, :3]).mean(weights)
        now = Rotation.from_matrix(here[:3, :3]).inv()
        motion = now.apply(weights @ poses[:, :3, 3] - here[:3, 3])
        return np.array([*motion, *(now * turn).as_euler("xyz"), float(opened > 0.5)])


@dataclass(frozen=True)
class _Plan:
    """A chunk, decoded: (K, 4, 4) poses in the arm's base, (K,) commands, and for how many steps it has been there."""

    poses: Array
    opened: NDArray[np.float64]
    age: int = 0

    def older(self) -> _Plan:
        """The same a step later."""
        return replace(self, age=self.age + 1)

    def open(self) -> _Plan:
        """The same with an open hand."""
        return replace(self, opened=np.ones_like(self.opened))
