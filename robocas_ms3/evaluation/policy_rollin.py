"""Roll in a learned policy before the scripted policy continues (DAgger demonstrations).

The policy acts as in the protocol `PROTOCOL` (stepping of RoboCAS-v0 at 5 Hz), in scenes of any configuration.
"""

from __future__ import annotations

import json
import logging
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from mani_skill.utils.common import to_numpy

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.datasets.conversion.env_renderer import require_renderer
from robocas_ms3.demos.failures import Intervention
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.evaluation.action_wrapper import V0_CONTROL_HZ, PolicyActionWrapper, make_env_kwargs
from robocas_ms3.evaluation.policies import open_policy
from robocas_ms3.evaluation.policy import EpisodeSpec, Policy
from robocas_ms3.evaluation.protocol import load_protocol
from robocas_ms3.evaluation.rollout import EndConditions, EpisodeBatch, run_rollouts
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.vector import RoboCASVectorEnv

PROTOCOL = "paper-v1"
_STEPS = 410  # random stream of the number of steps
_log = logging.getLogger(__name__)


def sample_roll_in_steps(seed: int, after_steps: tuple[int, int]) -> int:
    """Draw the number of policy steps for a seed, uniform in ``after_steps`` (both ends included)."""
    return int(np.random.default_rng([seed, _STEPS]).integers(after_steps[0], after_steps[1] + 1))


def check_roll_in_policy(settings: EpisodeSettings) -> str:
    """Check the policy of ``after_policy``; return the hash of its weights (empty without weights)."""
    with open_policy(settings.after_policy) as policy:
        load_protocol(PROTOCOL).rules.check_policy(policy.spec)
        if policy.spec.cameras:
            require_renderer()
        return str(getattr(policy, "describe", dict)().get("weights", ""))


class PolicyRollIn:
    """A worker (`core.workers.Worker`) that rolls in a policy in one environment, one scene per seed."""

    def __init__(self, settings: EpisodeSettings) -> None:
        self._settings, self._open = settings, ExitStack()
        self._policy: Policy = self._open.enter_context(open_policy(settings.after_policy))
        spec = self._policy.spec
        env = gym.make(
            TASKS[settings.task].env_id,
            config=settings.config,
            layouts=settings.layouts,
            pack=settings.pack,
            robot_uids=settings.robot,
            sim_backend="physx_cpu",
            **make_env_kwargs(spec, V0_CONTROL_HZ),
        )
        self._env = PolicyActionWrapper(env, spec, "upstream")
        self._base: Any = env.unwrapped
        options = {"auto_reset": False, "ignore_terminations": True, "record_metrics": False}
        self._vector = RoboCASVectorEnv(self._env, "numpy", **options)
        folder = self._open.enter_context(tempfile.TemporaryDirectory(prefix="robocas-config-"))
        self._config = Path(folder) / "config.yaml"  # policies expect a file
        config = load_task_config(settings.config).model_dump(mode="json")
        self._config.write_text(json.dumps(config), encoding="utf-8")

    def run(self, seed: int) -> Intervention:
        """Run the policy in the scene of a seed and return the state in which it leaves the scene."""
        settings, steps = self._settings, sample_roll_in_steps(seed, self._settings.after_steps)
        batch = EpisodeBatch(self._vector, self._policy.spec, EndConditions(steps), 1 / V0_CONTROL_HZ, refill=False)
        try:
            self._vector.reset(seed=[seed])
            (played,) = run_rollouts(batch, self._policy, [self._episode(seed)])
        except LayoutError:
            return Intervention(seed, settings.after_policy, 0, {}, 1.0, "no_layout")
        if played.error:
            _log.warning("seed %d: %s", seed, played.error)
        reasons = {
            "policy_failed": played.error,
            "succeeded": played.at_end["success"],
            "failed": played.at_end["fail"],
        }
        skip_reason = next((reason for reason, applies in reasons.items() if applies), "")
        state: dict[str, Any] = self._base.get_state_dict()
        state = {kind: to_numpy(values) for kind, values in state.items() if kind != "controller"}
        gripper = 1.0 if self._env.is_gripper_commanded_open else -1.0
        return Intervention(seed, settings.after_policy, played.steps, state, gripper, skip_reason)

    def close(self) -> None:
        self._env.close()
        self._open.close()

    def _episode(self, seed: int) -> EpisodeSpec:
        settings, text = self._settings, self._base.instruction().text
        files = (str(self._config), settings.layouts, settings.pack)
        return EpisodeSpec(-1, 0, settings.task, *files, seed, text, robot=settings.robot)
