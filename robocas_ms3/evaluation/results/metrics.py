"""Metrics of an episode: sums and maxima since the reset, and the retrieval order in search."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from robocas_ms3.core.arrays import as_float32, as_tensor, known_all_false, maximum, norm, to_native, where
from robocas_ms3.evaluation.results.outcomes import MEASURES
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.base import RoboCASEnv
from robocas_ms3.tasks.bodies import read_link_poses
from robocas_ms3.tasks.goals import TaskState
from robocas_ms3.tasks.search import ENVS_AT_ONCE, RoboCASSearchEnv

V0_RADIUS = 0.1  # m between the origins of target and basket in xy: RoboCAS-v0's success
SUMS = (*MEASURES, "v0_steps")  # columns of ``info["sums"]``
_PATH, _IMPULSE, _DISTURBED, _FALLEN, _V0_STEPS = range(len(SUMS))
# An object is on top of another object if it hides this fraction of it from above. The fraction is estimated from
# points, with an error of 0.08 at the 95th percentile.
COVER_THRESHOLD = 0.1
SIMULTANEOUS_SECONDS = 1.0  # simulated time within which objects that are pushed together start to move
_NEVER = 2**30  # control steps


class EpisodeMetrics:
    """Metrics of each env of a RoboCAS environment, accumulated since the reset of the env.

    Call `update` after each control step, and `end_step` and `compute_info` once per policy step. The contact impulse
    is the sum of force times control step, with the forces at the end of each control step. It is accurate for lasting
    contacts and an estimate for short impacts. If no object has moved or touched the gripper since the last call (same
    `TaskState`), `update` reads only the TCP.
    """

    def __init__(self, env: RoboCASEnv) -> None:
        self._env = env
        self._sums: Any = to_native(torch.zeros(env.num_envs, len(SUMS), device=env.device))
        self._near = to_native(torch.zeros(env.num_envs, dtype=torch.bool, device=env.device))
        self._in_v0: Any = to_native(torch.zeros(env.num_envs, dtype=torch.bool, device=env.device))
        self._tcp = self._read_tcp_positions()
        self._last_state: TaskState | None = None
        self._retrieval = RetrievalTracker(env) if isinstance(env, RoboCASSearchEnv) else None

    def reset(self, envs: Any) -> None:
        """Set the metrics of ``envs`` (indices or a slice) to 0, for new episodes."""
        self._sums[envs] = 0
        self._near[envs] = self._in_v0[envs] = False
        self._tcp[envs] = self._read_tcp_positions()[envs]
        self._last_state = None
        if self._retrieval is not None:
            self._retrieval.reset(envs)

    def forget_grasp(self) -> None:
        """Record moved objects again although the target was held, because an audit returned to an earlier state."""
        if self._retrieval is not None:
            self._retrieval.forget_grasp()

    def update(self, open_commands: np.ndarray) -> None:
        """Add a control step to the metrics.

        ``open_commands`` (N,) bool: whether the last command to each gripper was to open.
        """
        env, sums = self._env, self._sums
        tcp = self._read_tcp_positions()
        sums[:, _PATH] += norm(tcp - self._tcp)
        self._tcp = tcp
        state = env.success_check.state
        if state is not self._last_state:
            self._last_state = state
            impulse = norm(state.gripper_forces).sum((1, 2)) * env.control_timestep
            sums[:, _IMPULSE] += impulse
            sums[:, _DISTURBED] = maximum(sums[:, _DISTURBED], as_float32(state.disturbed.sum(1)))
            sums[:, _FALLEN] = maximum(sums[:, _FALLEN], as_float32(env.success_check.fallen_objects().sum(1)))
            target = terms.select_target(state.object_states[..., :2], to_native(env.target_slot))
            if state.basket_pose is not None:  # without a basket the rule never holds
                self._near = norm(target - state.basket_pose[:, :2]) <= V0_RADIUS
            if self._retrieval is not None:
                self._retrieval.update(state)
        open_command = (
            torch.as_tensor(open_commands, device=env.device) if isinstance(tcp, torch.Tensor) else open_commands
        )
        self._in_v0 = self._near & open_command

    def _read_tcp_positions(self) -> Any:
        # takes a fourth of the time of `tcp.pose`
        return read_link_poses(self._env.scene, [self._env.agent.tcp])[:, 0, :3]

    def end_step(self) -> None:
        """End a policy step: add it to ``v0_steps`` if RoboCAS-v0's rule holds, and to the retrieval order."""
        self._sums[:, _V0_STEPS] += self._in_v0
        if self._retrieval is not None:
            self._retrieval.end_step()

    def compute_info(self) -> dict[str, torch.Tensor]:
        """Return the metrics since the reset as entries of ``info``.

        - ``sums`` (N, 5) float32, with the columns `SUMS`: path length of the TCP in m; contact impulse between gripper
          and objects in N s; maximum number of disturbed objects; maximum number of fallen objects; number of policy
          steps in which RoboCAS-v0's success rule held.
        - ``success_v0`` (N,) bool: whether RoboCAS-v0's rule holds now; missing in scenes without a basket.
        - ``retrieval``, only in search: see `RetrievalTracker.compute_record`.
        """
        order = {} if self._retrieval is None else {"retrieval": self._retrieval.compute_record()}
        v0 = {} if self._env.model.basket is None else {"success_v0": as_tensor(self._in_v0).clone()}
        return {"sums": as_tensor(self._sums).clone(), **v0, **order}


def read_metric(info: dict[str, Any], name: str) -> Any:
    """Return a metric (N,) from ``info["sums"]``, by the name of its column in `SUMS`."""
    return info["sums"][:, SUMS.index(name)]


class RetrievalTracker:
    """Record of the policy steps at which the objects of each env are first moved, for the retrieval order in search.

    Call `update` after each control step and `end_step` after each policy step.

    An object counts as moved if it is displaced by more than 3 cm or has fallen over (``disturbed``) before the target
    is first held. An object is needed if at the reset it is an obstacle of `occlusion.measure_clutter`, if it hides at
    least 10 % of the target, or if it is on top of a needed object.
    """

    def __init__(self, env: RoboCASSearchEnv) -> None:
        self._env = env
        shape = tuple(env.present.shape)
        self._over = torch.zeros(*shape, shape[1], dtype=torch.bool, device=env.device)
        self._needed = torch.zeros(shape, dtype=torch.bool, device=env.device)
        self._moved_at = to_native(torch.zeros(shape, dtype=torch.int16, device=env.device))
        self._moved_time = to_native(torch.zeros(shape, dtype=torch.int32, device=env.device))  # control steps
        # whether the target has been held
        self._held = to_native(torch.zeros(shape[0], dtype=torch.bool, device=env.device))
        self._steps = to_native(torch.zeros(shape[0], dtype=torch.int16, device=env.device))
        self._record: Tensor | None = None  # result of `compute_record`; None after a change

    def reset(self, envs: Any) -> None:
        """Start new episodes in ``envs`` (indices or a slice): find the objects that must be moved."""
        for some in torch.arange(len(self._steps), device=self._env.device)[envs].split(ENVS_AT_ONCE):
            self._reset(some)

    def _reset(self, envs: Tensor) -> None:
        env = self._env
        over = env.measure_pairwise_occlusion(envs) >= COVER_THRESHOLD
        rows = torch.arange(len(over), device=env.device)
        over[rows, env.target_slot[envs]] = False  # objects under the target may be moved before it
        blocking = env.measure_clutter(envs).obstacles | over[rows, :, env.target_slot[envs]]
        self._over[envs], self._needed[envs] = over, find_objects_to_move(blocking, over)
        some = to_native(envs)
        self._moved_at[some], self._moved_time[some], self._steps[some] = 0, _NEVER, 0
        self._held[some], self._record = False, None

    def update(self, state: TaskState) -> None:
        """Record the objects that have moved in a control step."""
        self._held |= state.target_held
        now = state.disturbed & (self._moved_at == 0) & ~self._held[:, None]
        if known_all_false(now):
            return
        self._record = None
        time = to_native(self._env.elapsed_steps.to(torch.int32))[:, None]
        self._moved_at = where(now, self._steps[:, None] + 1, self._moved_at)
        self._moved_time = where(now, time, self._moved_time)

    def forget_grasp(self) -> None:
        """Continue as if the target had not been held in any env."""
        self._held[:] = False

    def end_step(self) -> None:
        """Count a policy step."""
        self._steps += 1

    def compute_record(self) -> Tensor:
        """Return the record (N, K, 3) int16 of the K objects by slot.

        Columns: policy step after which the object was first moved (first step: 1; never: 0); whether the object was
        needed; whether the object was moved in order. In order means that all objects on top of it were moved before it
        or at most one second after it, because objects that are pushed together move at almost the same time.
        """
        if self._record is not None:
            return self._record
        second = round(SIMULTANEOUS_SECONDS / self._env.control_timestep)
        moved_at, time = as_tensor(self._moved_at), as_tensor(self._moved_time)
        late = time[:, :, None] > time[:, None] + second  # row later than column
        in_order = (moved_at > 0) & self._needed & ~(self._over & late).any(dim=1)
        self._record = torch.stack([moved_at, self._needed.short(), in_order.short()], dim=-1)
        return self._record


def find_objects_to_move(blocking: Tensor, over: Tensor) -> Tensor:
    """Return whether each object must be moved (N, K): the blocking objects, and all objects on top of them.

    Args:
        blocking: (N, K) whether the object itself blocks the target.
        over: (N, K, K) whether the row object is on top of the column object.
    """
    found = blocking
    for _ in range(blocking.shape[1]):
        found = found | (over & found[:, None]).any(dim=2)
    return found
