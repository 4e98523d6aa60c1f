"""Metrics of an episode: sums and maxima since the reset, and the retrieval order in search."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from robocas_ms3.core.arrays import as_float, as_tensor, known_all_false, maximum, norm, to_native, where
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.base import RoboCASEnv
from robocas_ms3.tasks.bodies import link_poses
from robocas_ms3.tasks.goals import TaskState
from robocas_ms3.tasks.search import ENVS_AT_ONCE, RoboCASSearchEnv

V0_RADIUS = 0.1  # m between the origins of target and basket in xy: RoboCAS-v0's success
MEASURES = ("path_length", "contact_impulse", "disturbed_most", "fallen")
SUMS = (*MEASURES, "v0_steps")  # columns of ``info["sums"]``
_PATH, _IMPULSE, _DISTURBED, _FALLEN, _V0_STEPS = range(len(SUMS))
# An object is on top of another object if it hides this fraction of it from above. The fraction is estimated from
# points, with an error of 0.08 at the 95th percentile.
COVER_THRESHOLD = 0.1
SIMULTANEOUS_SECONDS = 1.0  # simulated time within which objects that are pushed together start to move
_NEVER = 2**30  # control steps


class EpisodeMetrics:
    """Metrics of each env of a RoboCAS environment, accumulated since its reset.

    Call `update` after each control step, and `end_step` and `read` once per policy step. The impulse integrates the
    forces after each control step: accurate for lasting contacts, an estimate for short impacts. If nothing
    has moved or touched the gripper since the last call (`TaskState`), only the TCP is read.
    """

    def __init__(self, env: RoboCASEnv) -> None:
        self._env = env
        self._sums: Any = to_native(torch.zeros(env.num_envs, len(SUMS), device=env.device))
        self._near = to_native(torch.zeros(env.num_envs, dtype=torch.bool, device=env.device))
        self._in_v0: Any = to_native(torch.zeros(env.num_envs, dtype=torch.bool, device=env.device))
        self._tcp = self._tcp_pos()
        self._moment: TaskState | None = None
        self._retrieval = RetrievalOrder(env) if isinstance(env, RoboCASSearchEnv) else None

    def reset(self, envs: Any) -> None:
        """Start new episodes in some envs."""
        self._sums[envs] = 0
        self._near[envs] = self._in_v0[envs] = False
        self._tcp[envs] = self._tcp_pos()[envs]
        self._moment = None
        if self._retrieval is not None:
            self._retrieval.reset(envs)

    def update(self, opened: np.ndarray) -> None:
        """Add a control step; ``opened`` (N,): whether the last command to each gripper was to open."""
        env, sums = self._env, self._sums
        tcp = self._tcp_pos()
        sums[:, _PATH] += norm(tcp - self._tcp)
        self._tcp = tcp
        moment = env.success_check.state
        if moment is not self._moment:
            self._moment = moment
            impulse = norm(moment.forces).sum((1, 2)) * env.control_timestep
            sums[:, _IMPULSE] += impulse
            sums[:, _DISTURBED] = maximum(sums[:, _DISTURBED], as_float(moment.disturbed.sum(1)))
            sums[:, _FALLEN] = maximum(sums[:, _FALLEN], as_float(env.success_check.fallen_objects().sum(1)))
            target = terms.select_target(moment.objects[..., :2], to_native(env.target_slot))
            if moment.basket is not None:  # without a basket the rule never holds
                self._near = norm(target - moment.basket[:, :2]) <= V0_RADIUS
            if self._retrieval is not None:
                self._retrieval.update(moment)
        open_command = torch.as_tensor(opened, device=env.device) if isinstance(tcp, torch.Tensor) else opened
        self._in_v0 = self._near & open_command

    def _tcp_pos(self) -> Any:
        return link_poses(self._env.scene, [self._env.agent.tcp])[:, 0, :3]  # takes a fourth of the time of `tcp.pose`

    def end_step(self) -> None:
        """End a policy step."""
        self._sums[:, _V0_STEPS] += self._in_v0
        if self._retrieval is not None:
            self._retrieval.end_step()

    def read(self) -> dict[str, torch.Tensor]:
        """Return the metrics since the reset as entries of ``info``.

        ``sums`` (N, 5) has the columns ``SUMS``: path length of the TCP in m; contact impulse between gripper and
        objects in N s; maximum numbers of disturbed and of fallen objects; policy steps in which RoboCAS-v0's rule has
        held. ``success_v0`` (N,) bool: whether the rule holds now, if there is a basket. In search also ``retrieval``
        (`RetrievalOrder.read`).
        """
        order = {} if self._retrieval is None else {"retrieval": self._retrieval.read()}
        v0 = {} if self._env.model.basket is None else {"success_v0": as_tensor(self._in_v0).clone()}
        return {"sums": as_tensor(self._sums).clone(), **v0, **order}


def read_sum(info: dict[str, Any], name: str) -> Any:
    """Return a column of ``info["sums"]`` by name, (N,)."""
    return info["sums"][:, SUMS.index(name)]


class RetrievalOrder:
    """Policy steps at which the objects of each env were first moved.

    Call `update` after each control step and `end_step` after each policy step.

    An object counts as moved if it was displaced by more than 3 cm or had fallen over (`disturbed`) before the target
    was first held. It was **needed** if at the reset it hid or hemmed in the target (an obstacle of
    `occlusion.clutter`, or it hid a tenth of the target), or if it was on top of a needed object.
    """

    def __init__(self, env: RoboCASSearchEnv) -> None:
        self._env = env
        shape = tuple(env.present.shape)
        self._over = torch.zeros(*shape, shape[1], dtype=torch.bool, device=env.device)
        self._needed = torch.zeros(shape, dtype=torch.bool, device=env.device)
        self._moved_at = to_native(torch.zeros(shape, dtype=torch.int16, device=env.device))
        self._moved_time = to_native(torch.zeros(shape, dtype=torch.int32, device=env.device))  # control steps
        self._held = to_native(
            torch.zeros(shape[0], dtype=torch.bool, device=env.device)
        )  # whether the target has been held
        self._steps = to_native(torch.zeros(shape[0], dtype=torch.int16, device=env.device))
        self._found: Tensor | None = None  # result of `read`, until something changes

    def reset(self, envs: Any) -> None:
        """Start new episodes in some envs."""
        for some in torch.arange(len(self._steps), device=self._env.device)[envs].split(ENVS_AT_ONCE):
            self._reset(some)

    def _reset(self, envs: Tensor) -> None:
        env = self._env
        over = env.pairwise_occlusion(envs) >= COVER_THRESHOLD
        rows = torch.arange(len(over), device=env.device)
        over[rows, env.target_slot[envs]] = False  # objects under the target may be moved before it
        first = env.clutter(envs).obstacles | over[rows, :, env.target_slot[envs]]
        self._over[envs], self._needed[envs] = over, objects_to_move(first, over)
        some = to_native(envs)
        self._moved_at[some], self._moved_time[some], self._steps[some] = 0, _NEVER, 0
        self._held[some], self._found = False, None

    def update(self, moment: TaskState) -> None:
        self._held |= moment.held
        now = moment.disturbed & (self._moved_at == 0) & ~self._held[:, None]
        if known_all_false(now):
            return
        self._found = None
        time = to_native(self._env.elapsed_steps.to(torch.int32))[:, None]
        self._moved_at = where(now, self._steps[:, None] + 1, self._moved_at)
        self._moved_time = where(now, time, self._moved_time)

    def end_step(self) -> None:
        self._steps += 1

    def read(self) -> Tensor:
        """Return the record (N, K, 3) int16 of the objects by slot.

        The columns are the policy step after which the object was first moved (from 1 on; 0: never), whether it was
        needed, and whether it was moved in order: the objects on top of it moved earlier or within one second, as
        objects that are pushed together do.
        """
        if self._found is not None:
            return self._found
        second = round(SIMULTANEOUS_SECONDS / self._env.control_timestep)
        moved_at, time = as_tensor(self._moved_at), as_tensor(self._moved_time)
        late = time[:, :, None] > time[:, None] + second  # row later than column
        in_order = (moved_at > 0) & self._needed & ~(self._over & late).any(dim=1)
        self._found = torch.stack([moved_at, self._needed.short(), in_order.short()], dim=-1)
        return self._found


def objects_to_move(first: Tensor, over: Tensor) -> Tensor:
    """Return which objects must be moved, (N, K): ``first``, and all objects on top of them.

    ``over`` (N, K, K): whether the row object is on top of the column object.
    """
    found = first
    for _ in range(first.shape[1]):
        found = found | (over & found[:, None]).any(dim=2)
    return found
