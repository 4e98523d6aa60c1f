"""What happens to env and objects between two actions of a policy: sums and extremes since the reset."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from robocas_ms3.core.arrays import as_float, as_tensor, greater, length, native
from robocas_ms3.evaluation.retrieval import Retrieval
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.bodies import link_poses
from robocas_ms3.tasks.search import RoboCASSearchEnv
from robocas_ms3.tasks.transfer import Moment, TransferEnv

V0_RADIUS = 0.1  # m between the origins of target and basket in xy: upstream's success
V0_STEPS = 5  # policy steps like that after which upstream's episode ends
MEASURES = ("path_length", "contact_impulse", "disturbed_most", "fallen")
SUMS = (*MEASURES, "v0_steps")  # columns of what is read
_PATH, _IMPULSE, _DISTURBED, _FALLEN, _V0_STEPS = range(len(SUMS))


class Tracker:
    """Keeps numbers of each env, read once a policy step.

    Looked at after every control step; the impulse is that of the forces found there, so it is right for what lasts,
    and an estimate for knocks. Where nothing has moved or touched the gripper since the last look (`Moment`), only the
    TCP is looked at.

    Args:
        env: a RoboCAS environment, which has been reset.
    """

    def __init__(self, env: TransferEnv) -> None:
        self._env = env
        self._sums = native(torch.zeros(env.num_envs, len(SUMS), device=env.device))
        self._near = native(torch.zeros(env.num_envs, dtype=torch.bool, device=env.device))
        self._in_v0 = native(torch.zeros(env.num_envs, dtype=torch.bool, device=env.device))
        self._tcp = self._tcp_pos()
        self._moment: Moment | None = None
        self._retrieval = Retrieval(env) if isinstance(env, RoboCASSearchEnv) else None

    def reset(self, envs: Any) -> None:
        """Begin anew in some envs."""
        self._sums[envs] = 0
        self._near, self._in_v0 = _cleared(self._near, envs), _cleared(self._in_v0, envs)
        self._tcp[envs] = self._tcp_pos()[envs]
        self._moment = None
        if self._retrieval is not None:
            self._retrieval.reset(envs)

    def look(self, opened: np.ndarray) -> None:
        """Count on after a control step.

        Args:
            opened: (N,) bool, whether each gripper was told to be open.
        """
        env, sums = self._env, self._sums
        tcp = self._tcp_pos()
        sums[:, _PATH] += length(tcp - self._tcp)
        self._tcp = tcp
        moment = env.moment
        if moment is not self._moment:
            self._moment = moment
            impulse = length(moment.forces).sum((1, 2)) * env.control_timestep
            sums[:, _IMPULSE] += impulse
            sums[:, _DISTURBED] = greater(sums[:, _DISTURBED], as_float(moment.disturbed.sum(1)))
            sums[:, _FALLEN] = greater(sums[:, _FALLEN], as_float(env.fallen().sum(1)))
            target = terms.of_target(moment.objects[..., :2], native(env.target_slot))
            if moment.basket is not None:  # else that rule never holds
                self._near = length(target - moment.basket[:, :2]) <= V0_RADIUS
            if self._retrieval is not None:
                self._retrieval.look(moment)
        told = torch.as_tensor(opened, device=env.device) if isinstance(tcp, torch.Tensor) else opened
        self._in_v0 = self._near & told

    def _tcp_pos(self) -> Any:
        return native(link_poses(self._env.scene, [self._env.agent.tcp]))[:, 0, :3]  # a fourth of `tcp.pose`'s time

    def end_step(self) -> None:
        """Count a policy step, after its last control step."""
        self._sums[:, _V0_STEPS] += self._in_v0
        if self._retrieval is not None:
            self._retrieval.end_step()

    def read(self) -> dict[str, torch.Tensor]:
        """What was kept since the reset, for an info.

        ``sums`` (N, 5), see ``SUMS``: m of the TCP's path; N s between gripper and objects; numbers of objects
        disturbed at once, and fallen; policy steps that upstream's rule has held. ``success_v0`` (N,) bool, that rule
        at this moment, where there is a basket. Of search also ``retrieval``, `Retrieval.read`.
        """
        order = {} if self._retrieval is None else {"retrieval": self._retrieval.read()}
        v0 = {} if self._env.model.basket is None else {"success_v0": as_tensor(self._in_v0)}
        return {"sums": as_tensor(self._sums).clone(), **v0, **order}


def summed(info: dict[str, Any], name: str) -> Any:
    """(N,) of an info's ``sums``, the one of that name."""
    return info["sums"][:, SUMS.index(name)]


def _cleared(values: Any, envs: Any) -> Any:
    """Values that are zero in some envs."""
    changed = values.clone() if isinstance(values, torch.Tensor) else values.copy()
    changed[envs] = 0
    return changed
