"""A policy that follows chunks of poses, and averages the predictions of overlapping chunks."""

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
"""Width in m of a gripper that has closed on nothing."""

Predict = Callable[[Observations, int], NDArray[np.floating]]


class ChunkPolicy:
    """Acts in RoboCAS' convention of seven numbers, relative to the TCP.

    The policy follows a chunk for some steps before it predicts the next one. A network that sees images and no
    velocities takes each pause for the slow start of a motion: asked at every step, it would creep, and never close
    the gripper. The pose of a step is the mean of its predictions, weighted by exp(-fade age) (Zhao et al. 2023 weight
    the oldest most; at 5 Hz the newest is better).

    The reopen heuristic is not learned: a gripper that closed on nothing and has not moved since the last chunk is
    opened. A failed grasp looks like pushing with a closed gripper, and the network would wait for ever.

    Args:
        spec: of the policy; images are rendered for new chunks only.
        predict: returns a (K, 10) chunk for observations and a row of them, see `poses`.
        play: steps of a chunk before the next one, up to K.
        fade: decay of the weight of older predictions, per step.
        about: what results record about the policy.
        reopen: distance in m; an empty gripper that moved less during a chunk is opened. 0: never.
    """

    def __init__(
        self, spec: PolicySpec, predict: Predict, play: int, fade: float, about: dict[str, Any], reopen: float = 0.0
    ) -> None:
        self.spec, self._predict, self._about = replace(spec, look_every=play), predict, about
        self._play, self._fade, self._reopen = play, fade, reopen
        self._plans: dict[int, list[_Plan]] = {}  # by env, newest first
        self._chunk_start: dict[int, Array] = {}  # by env, (3,) where the TCP was in the arm's base

    def describe(self) -> dict[str, Any]:
        """Return what results record about the policy."""
        return self._about

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Forget the chunks of these envs."""
        for start in starts:
            self._plans[start.env] = []
            self._chunk_start.pop(start.env, None)

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return actions (E, 7)."""
        tcp = from_wxyz(observations.tcp_in_base)
        envs = observations.envs.tolist()
        for env in envs:
            self._plans[env] = [plan.older() for plan in self._plans[env] if plan.age + 1 < len(plan.poses)]
        for row, env in enumerate(envs):
            if not self._plans[env] or self._plans[env][0].age >= self._play:
                chunk = self._predict(observations, row)  # alone: in a batch, its last bits depend on the other rows
                poses, opened = decode(chunk, tcp[row])
                self._plans[env].insert(0, _Plan(poses, opened))
                if self._is_stuck(env, tcp[row, :3, 3], float(observations.gripper_width.reshape(-1)[row])):
                    self._plans[env] = [plan.open() for plan in self._plans[env]]  # else older ones could outvote it
        return np.stack([self._next(self._plans[env], here) for env, here in zip(envs, tcp, strict=True)])

    def _is_stuck(self, env: int, here: Array, width: float) -> bool:
        """Return whether an empty gripper has not moved since the last chunk; stores its position."""
        before = self._chunk_start.get(env)
        self._chunk_start[env] = here.copy()
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
    """A decoded chunk: (K, 4, 4) poses in the arm's base, (K,) gripper commands, and its age in steps."""

    poses: Array
    opened: NDArray[np.float64]
    age: int = 0

    def older(self) -> _Plan:
        """Return the chunk a step later."""
        return replace(self, age=self.age + 1)

    def open(self) -> _Plan:
        """Return the chunk with an open gripper."""
        return replace(self, opened=np.ones_like(self.opened))
