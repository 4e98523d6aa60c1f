"""Acts by chunks of poses: asked at every step, it goes where its last few predictions agree to be next."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.chunks import decode
from robocas_ms3.evaluation.policy import Observations, Start, Wants
from robocas_ms3.poses import Array, from_wxyz

Predict = Callable[[Observations], NDArray[np.floating]]


class ChunkPolicy:
    """Speaks RoboCAS' seven numbers, relative to where the TCP is.

    A step's pose is the mean of what was predicted for it, now and at steps before, weighted by exp(-fade age) (Zhao et
    al. 2023 weigh the oldest most; at 5 Hz the newest knows more). The mean of two ways to go is none: what lies far from
    the newest prediction weighs less, by a Gaussian.

    Args:
        wants: what it is to be shown.
        predict: (E, K, 10) chunks of what E envs show, see `chunks`.
        fade: how fast older predictions lose weight, a step.
        agree: deviation of that Gaussian, m; 0: none.
        about: what a result says of it besides.
    """

    def __init__(self, wants: Wants, predict: Predict, fade: float, agree: float, about: dict[str, Any]) -> None:
        self.wants, self._predict, self._about = wants, predict, about
        self._fade, self._agree = fade, agree
        self._plans: dict[int, list[tuple[Array, NDArray[np.float64]]]] = {}  # by env, newest first

    def describe(self) -> dict[str, Any]:
        """What a result says of it besides."""
        return self._about

    def reset(self, starts: list[Start]) -> None:
        """Forget what was planned in these envs."""
        for start in starts:
            self._plans[start.env] = []

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """(E, 7) motions."""
        chunks = self._predict(observations)
        tcp = from_wxyz(observations.tcp_in_base)
        rows = zip(observations.envs.tolist(), chunks, tcp, strict=True)
        return np.stack([self._next(env, chunk, here) for env, chunk, here in rows])

    def _next(self, env: int, chunk: NDArray[np.floating], here: Array) -> NDArray[np.float64]:
        plans = self._plans[env] = [decode(chunk, here), *self._plans[env]][: len(chunk)]
        poses = np.stack([plan[0][age] for age, plan in enumerate(plans)])
        weights = np.exp(-self._fade * np.arange(len(plans)))
        if self._agree:
            weights *= np.exp(-np.square((poses - poses[0])[:, :3, 3] / self._agree).sum(axis=1) / 2)
        weights /= weights.sum()
        opened = float(weights @ [plan[1][age] for age, plan in enumerate(plans)])
        turn = Rotation.from_matrix(poses[:, :3, :3]).mean(weights)
        now = Rotation.from_matrix(here[:3, :3]).inv()
        motion = now.apply(weights @ poses[:, :3, 3] - here[:3, 3])
        return np.array([*motion, *(now * turn).as_euler("xyz"), float(opened > 0.5)])
