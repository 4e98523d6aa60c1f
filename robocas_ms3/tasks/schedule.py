"""Which envs of a batch are due for a measurement, known on the host: reading it from a GPU would wait for the GPU."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray


class PeriodicSchedule:
    """Counts the control steps of each env since its reset, modulo a period.

    Args:
        num_envs: N.
        period: control steps from one measurement of an env to the next.
        device: where the indices are that `due` returns.
    """

    def __init__(self, num_envs: int, period: int, device: torch.device | str) -> None:
        self._period, self._device = period, device
        self._step = 0
        self._reset_at = np.zeros(num_envs, dtype=np.int64)  # of `_step`
        self._always = np.zeros(num_envs, dtype=bool)
        self._indices: list[torch.Tensor] = []  # by `_step` modulo the period; empty: to be made

    def reset(self, envs: NDArray[np.int64]) -> None:
        """Note that some envs (E,) are reset: they are due before their first step, and every period from then on."""
        self._reset_at[envs], self._always[envs] = self._step, False
        self._indices = []

    def every_step(self, envs: NDArray[np.int64] | slice) -> None:
        """Let some envs be due in every step, until they are reset."""
        self._always[envs] = True
        self._indices = []

    def advance(self) -> None:
        """Note that all envs make a control step."""
        self._step += 1

    def due(self) -> torch.Tensor:
        """(D,) int64 indices of the envs that are due in the present step."""
        if not self._indices:  # of all phases at once: a copy to the GPU waits for it, so none is made within a step
            phases = np.arange(self._period)[:, None]
            due = ((phases - self._reset_at) % self._period == 0) | self._always
            self._indices = [torch.from_numpy(np.flatnonzero(row)).to(self._device) for row in due]
        return self._indices[self._step % self._period]
