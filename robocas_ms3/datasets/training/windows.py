"""Which steps of an episode make up a training sample: pure index arithmetic.

A sample belongs to a step t, 0 <= t <= T - 2: from each of these a motion leaves. It holds the observations
``t - H + 1 .. t`` and the actions ``t - H + 1 .. t + A - 1``. So with A = 1 there is one action beside each
observation, as upstream's models predict them, and the last A rows are the chunk that starts at t.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError

Steps = NDArray[np.int64]
Padding = Literal["hold", "zero", "drop"]


@dataclass(frozen=True)
class Window:
    """The shape of a sample.

    Attributes:
        observation: H, steps looked back on, the present one included.
        action: A, actions from the present step on.
        padding: what stands beyond an episode's ends. ``hold``: the robot stands still there (first picture, no
            motion, the gripper command nearest in time); ``zero``: zeros; ``drop``: nothing, such samples are left out.
    """

    observation: int = 6
    action: int = 1
    padding: Padding = "hold"

    def __post_init__(self) -> None:
        """Check it.

        Raises:
            DatasetError: a horizon below 1, or no such padding.
        """
        for name, horizon in (("observation_horizon", self.observation), ("action_horizon", self.action)):
            if isinstance(horizon, bool) or not isinstance(horizon, int) or horizon < 1:
                raise DatasetError(
                    "a horizon is a number of steps", where=name, expected="an integer >= 1", found=horizon
                )
        if self.padding not in get_args(Padding):
            expected = f"one of {', '.join(get_args(Padding))}"
            raise DatasetError("no such padding", where="padding", expected=expected, found=self.padding)

    def samples(self, length: int) -> range:
        """Steps of an episode of T steps which have a sample."""
        if self.padding == "drop":
            return range(self.observation - 1, max(self.observation - 1, length - self.action))
        return range(max(0, length - 1))

    def observed(self, step: int) -> Steps:
        """(H,) steps observed; below 0 before the episode."""
        return np.arange(step - self.observation + 1, step + 1)

    def acted(self, step: int) -> Steps:
        """(H + A - 1,) steps whose actions are given; below 0 or beyond T - 2 outside the episode."""
        return np.arange(step - self.observation + 1, step + self.action)
