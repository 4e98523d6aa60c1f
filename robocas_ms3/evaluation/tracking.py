"""What happens to env and objects between two actions of a policy: sums and extremes since the reset."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from robocas_ms3.evaluation.retrieval import Retrieval
from robocas_ms3.tasks.search import RoboCASSearchEnv

V0_RADIUS = 0.1  # m between the origins of target and basket in xy: upstream's success
V0_STEPS = 5  # policy steps like that after which upstream's episode ends


class Tracker:
    """Keeps (N,) numbers of each env, read once a policy step.

    Looked at after every control step; the impulse is that of the forces found there, so it is right for what lasts,
    and an estimate for knocks.

    Args:
        env: a RoboCAS environment.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        names = ("path_length", "contact_impulse", "disturbed_most", "fallen", "v0_steps")
        self._kept = {name: torch.zeros(env.num_envs, device=env.device) for name in names}
        self._in_v0 = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self._tcp: torch.Tensor | None = None
        self._searches = isinstance(env, RoboCASSearchEnv)
        self._retrieval: Retrieval | None = None

    def reset(self, envs: Any) -> None:
        """Begin anew in some envs."""
        for kept in self._kept.values():
            kept[envs] = 0.0
        self._in_v0[envs] = False
        now = self._env.agent.tcp_pos.clone()
        before = now.clone() if self._tcp is None else self._tcp
        before[envs] = now[envs]
        self._tcp = before
        if self._searches:
            if self._retrieval is None:
                self._retrieval = Retrieval(self._env)
            self._retrieval.reset(envs)

    def look(self, info: dict[str, Any], opened: np.ndarray) -> None:
        """Count on after a control step.

        Args:
            info: of that step.
            opened: (N,) bool, whether each gripper was told to be open.
        """
        env, kept = self._env, self._kept
        tcp = env.agent.tcp_pos
        kept["path_length"] += torch.linalg.vector_norm(tcp - self._tcp, dim=1)
        self._tcp = tcp.clone()
        forces = torch.linalg.vector_norm(env.gripper_forces(), dim=-1).sum(dim=(1, 2))
        kept["contact_impulse"] += forces * env.control_timestep
        kept["disturbed_most"] = torch.maximum(kept["disturbed_most"], info["disturbed"].float())
        kept["fallen"] = torch.maximum(kept["fallen"], env.fallen().sum(dim=1).float())
        slots = torch.arange(env.num_envs, device=env.device)
        target, basket = env.object_poses[slots, env.target_slot, :2], env.basket_pose[:, :2]
        near = torch.linalg.vector_norm(target - basket, dim=1) <= V0_RADIUS
        self._in_v0 = near & torch.as_tensor(opened, device=env.device)
        if self._retrieval is not None:
            self._retrieval.look(info)

    def end_step(self) -> None:
        """Count a policy step, after its last control step."""
        self._kept["v0_steps"] += self._in_v0
        if self._retrieval is not None:
            self._retrieval.end_step()

    def read(self) -> dict[str, torch.Tensor]:
        """(N,) each, for an info: what was kept, since the reset.

        ``path_length`` m of the TCP; ``contact_impulse`` N s between gripper and objects; ``disturbed_most`` and
        ``fallen``, numbers of objects; ``success_v0`` bool, upstream's rule at this moment, and ``v0_steps``, how many
        policy steps it has held. Of search also ``retrieval``, `Retrieval.read`.
        """
        kept = {name: value.clone() for name, value in self._kept.items()}
        order = {} if self._retrieval is None else {"retrieval": self._retrieval.read()}
        return {**kept, "success_v0": self._in_v0.clone(), **order}
