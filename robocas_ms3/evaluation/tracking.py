"""What happens to env and objects between two actions of a policy: sums and extremes since the reset."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from robocas_ms3.arrays import as_float, as_tensor, greater, length, native
from robocas_ms3.evaluation.retrieval import Retrieval
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.search import RoboCASSearchEnv
from robocas_ms3.tasks.transfer import Moment, TransferEnv

V0_RADIUS = 0.1  # m between the origins of target and basket in xy: upstream's success
V0_STEPS = 5  # policy steps like that after which upstream's episode ends
SUMS = ("path_length", "contact_impulse", "disturbed_most", "fallen", "v0_steps")


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
        self._kept = {name: native(torch.zeros(env.num_envs, device=env.device)) for name in SUMS}
        self._near = native(torch.zeros(env.num_envs, dtype=torch.bool, device=env.device))
        self._in_v0 = native(torch.zeros(env.num_envs, dtype=torch.bool, device=env.device))
        self._tcp = native(env.agent.tcp_pos.clone())
        self._moment: Moment | None = None
        self._retrieval = Retrieval(env) if isinstance(env, RoboCASSearchEnv) else None

    def reset(self, envs: Any) -> None:
        """Begin anew in some envs."""
        for name, kept in self._kept.items():
            self._kept[name] = _cleared(kept, envs)
        self._near, self._in_v0 = _cleared(self._near, envs), _cleared(self._in_v0, envs)
        self._tcp[envs] = native(self._env.agent.tcp_pos)[envs]
        self._moment = None
        if self._retrieval is not None:
            self._retrieval.reset(envs)

    def look(self, opened: np.ndarray) -> None:
        """Count on after a control step.

        Args:
            opened: (N,) bool, whether each gripper was told to be open.
        """
        env, kept = self._env, self._kept
        tcp = native(env.agent.tcp_pos.clone())
        kept["path_length"] = kept["path_length"] + length(tcp - self._tcp)  # infos hold the one of before
        self._tcp = tcp
        moment = env.moment
        if moment is not self._moment:
            self._moment = moment
            impulse = length(moment.forces).sum((1, 2)) * env.control_timestep
            kept["contact_impulse"] = kept["contact_impulse"] + impulse
            kept["disturbed_most"] = greater(kept["disturbed_most"], as_float(moment.disturbed.sum(1)))
            kept["fallen"] = greater(kept["fallen"], as_float(env.fallen().sum(1)))
            target = terms.of_target(moment.objects[..., :2], native(env.target_slot))
            self._near = length(target - moment.basket[:, :2]) <= V0_RADIUS
            if self._retrieval is not None:
                self._retrieval.look(moment)
        told = torch.as_tensor(opened, device=env.device) if isinstance(tcp, torch.Tensor) else opened
        self._in_v0 = self._near & told

    def end_step(self) -> None:
        """Count a policy step, after its last control step."""
        self._kept["v0_steps"] = self._kept["v0_steps"] + self._in_v0
        if self._retrieval is not None:
            self._retrieval.end_step()

    def read(self) -> dict[str, torch.Tensor]:
        """(N,) each, for an info: what was kept, since the reset.

        ``path_length`` m of the TCP; ``contact_impulse`` N s between gripper and objects; ``disturbed_most`` and
        ``fallen``, numbers of objects; ``success_v0`` bool, upstream's rule at this moment, and ``v0_steps``, how many
        policy steps it has held. Of search also ``retrieval``, `Retrieval.read`.
        """
        kept = {name: as_tensor(value) for name, value in self._kept.items()}
        order = {} if self._retrieval is None else {"retrieval": self._retrieval.read()}
        return {**kept, "success_v0": as_tensor(self._in_v0), **order}


def _cleared(values: Any, envs: Any) -> Any:
    """Values that are zero in some envs."""
    changed = values.clone() if isinstance(values, torch.Tensor) else values.copy()
    changed[envs] = 0
    return changed
