"""Watches what is moved before the target is taken out of its heap: in which order, and whether that was needed."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from robocas_ms3.core.arrays import as_tensor, choose, native, none
from robocas_ms3.tasks.search import ENVS_AT_ONCE, RoboCASSearchEnv
from robocas_ms3.tasks.transfer import Moment

# share of an object that another one hides from above, from which on it lies over it; what is measured of points is off
# by 0.08 at the 95th percentile
LIES_OVER = 0.1
TOGETHER = 1.0  # s of the scene in which objects that are pushed as one begin to move
_NEVER = 2**30  # control steps


class Retrieval:
    """Keeps of each env when its objects were first moved; looked at after every control step.

    An object was moved when it is more than 3 cm from where it stood or has fallen over (`disturbed`), by whatever
    chain of pushes, before the target was first held. It was **needed** if at the reset it hid or hemmed in the target
    (an obstacle of `occlusion.clutter`, or it hid a tenth of it) or lay over one that was, and so on upwards.

    Args:
        env: search's environment.
    """

    def __init__(self, env: RoboCASSearchEnv) -> None:
        self._env = env
        shape = tuple(env.present.shape)
        self._over = torch.zeros(*shape, shape[1], dtype=torch.bool, device=env.device)
        self._needed = torch.zeros(shape, dtype=torch.bool, device=env.device)
        self._moved_at = native(torch.zeros(shape, dtype=torch.int16, device=env.device))
        self._moved_time = native(torch.zeros(shape, dtype=torch.int32, device=env.device))  # control steps
        self._held = native(torch.zeros(shape[0], dtype=torch.bool, device=env.device))  # by now
        self._steps = native(torch.zeros(shape[0], dtype=torch.int16, device=env.device))
        self._found: Tensor | None = None  # of `read`, until something changes

    def reset(self, envs: Any) -> None:
        """Begin anew in some envs, from the heaps as they lie."""
        for some in torch.arange(len(self._steps), device=self._env.device)[envs].split(ENVS_AT_ONCE):
            self._begin(some)

    def _begin(self, envs: Tensor) -> None:
        env = self._env
        over = env.covering(envs) >= LIES_OVER
        rows = torch.arange(len(over), device=env.device)
        over[rows, env.target_slot[envs]] = False  # what the target lies on need not wait for it
        first = env.clutter(envs).obstacles | over[rows, :, env.target_slot[envs]]
        self._over[envs], self._needed[envs] = over, needed(first, over)
        some = native(envs)
        self._moved_at[some], self._moved_time[some], self._steps[some] = 0, _NEVER, 0
        self._held[some], self._found = False, None

    def look(self, moment: Moment) -> None:
        """Look at what has moved in a control step of the policy step that has begun."""
        self._held |= moment.held
        now = moment.disturbed & (self._moved_at == 0) & ~self._held[:, None]
        if none(now):
            return
        self._found = None
        time = native(self._env.elapsed_steps.to(torch.int32))[:, None]
        self._moved_at = choose(now, self._steps[:, None] + 1, self._moved_at)
        self._moved_time = choose(now, time, self._moved_time)

    def end_step(self) -> None:
        """Count a policy step."""
        self._steps += 1

    def read(self) -> Tensor:
        """(N, K, 3) int16, of each object.

        The policy step after which each object was first moved, from 1 on, or 0; whether it was needed; and whether
        that came in order: what lay over it moved earlier, or within a second, as what is pushed as one does.
        """
        if self._found is not None:
            return self._found
        second = round(TOGETHER / self._env.control_timestep)
        moved_at, time = as_tensor(self._moved_at), as_tensor(self._moved_time)
        late = time[:, :, None] > time[:, None] + second  # row later than column
        in_order = (moved_at > 0) & self._needed & ~(self._over & late).any(dim=1)
        self._found = torch.stack([moved_at, self._needed.short(), in_order.short()], dim=-1)
        return self._found


def needed(first: Tensor, over: Tensor) -> Tensor:
    """What has to be moved: some objects (N, K), and what lies ``over`` (N, K, K; row over column) these, and so on."""
    found = first
    for _ in range(first.shape[1]):
        found = found | (over & found[:, None]).any(dim=2)
    return found
