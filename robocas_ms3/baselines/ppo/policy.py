"""What `ppo` has learned, as a policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robocas_ms3.baselines.ppo.agent import Agent
from robocas_ms3.baselines.ppo.trials import arm_action, seen
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.robots.ee_deltas import POSITION_SCALE, ROTATION_SCALE

_SCALE = np.array([POSITION_SCALE] * 3 + [ROTATION_SCALE] * 3 + [1.0])


class PpoPolicy:
    """Acts without noise, in the convention that ``pd_ee_delta_pose`` stands for.

    Args:
        facts: of its trials.
        agent: what was learned.
    """

    def __init__(self, facts: dict[str, Any], agent: Agent) -> None:
        # it turns about one axis alone, about which Euler angles and rotation vectors are the same
        self.spec = PolicySpec(
            "delta_axis_angle", reference="target", rate_hz=facts["rate_hz"], state=True, language="none"
        )
        self._agent, self._size = agent, facts["observed"]

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Nothing is kept of an episode."""

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """(E, 7) motions.

        Raises:
            EvaluationError: the scenes hold another number of things than those it learned in.
        """
        assert observations.state is not None
        obs = seen(observations.qpos, observations.tcp_in_base, observations.gripper_width, observations.state)
        if obs.shape[1] != self._size:
            what, fix = "other scenes than it was trained in", "Evaluate it in the task and scenes of its trials."
            raise EvaluationError(what, where="ppo", expected=f"{self._size} numbers", found=obs.shape[1], fix=fix)
        with torch.inference_mode():
            action = arm_action(self._agent.best(obs.to(self._agent.mean.device)))
        return action.double().cpu().numpy() * _SCALE
