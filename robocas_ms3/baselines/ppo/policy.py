"""The policy of `ppo`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.ppo.agent import Agent
from robocas_ms3.baselines.ppo.environments import expand_action, join_observation
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.robots.ee_deltas import POSITION_SCALE, ROTATION_SCALE

_SCALE = np.array([POSITION_SCALE] * 3 + [ROTATION_SCALE] * 3 + [1.0])


class PpoPolicy:
    """Acts without noise, in the convention of ``pd_ee_delta_pose``.

    Args:
        facts: of the environments.
        agent: trained.
    """

    def __init__(self, facts: dict[str, Any], agent: Agent) -> None:
        # Rotations are about one axis, where Euler angles and rotation vectors are the same
        self.spec = PolicySpec(
            "delta_axis_angle", reference="target", rate_hz=facts["rate_hz"], state=True, language="none"
        )
        self._agent, self._size = agent, facts["observed"]

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Do nothing: the policy keeps no state."""

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return actions (E, 7).

        Raises:
            EvaluationError: the scenes hold another number of objects than those of the training.
        """
        assert observations.state is not None
        obs = join_observation(
            observations.qpos, observations.tcp_in_base, observations.gripper_width, observations.state
        )
        if obs.shape[1] != self._size:
            what, fix = "the policy was trained in other scenes", "Evaluate it in the task and scenes of its training."
            raise EvaluationError(what, where="ppo", expected=f"{self._size} numbers", found=obs.shape[1], fix=fix)
        with torch.inference_mode():
            action = expand_action(self._agent.best(obs.to(self._agent.mean.device)))
        return action.double().cpu().numpy() * _SCALE
