"""Run a learned policy before the scripted policy continues (DAgger demonstrations).

The policy acts by the rules of the protocol `PROTOCOL` (steps of RoboCAS-v0 at 5 Hz), in scenes of any configuration.
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
from robocas_ms3.evaluation.policies import open_policy
from robocas_ms3.evaluation.policy import EpisodeSpec, Policy
from robocas_ms3.evaluation.protocols.protocol import check_cameras, load_protocol
from robocas_ms3.evaluation.rollouts.action_wrapper import (
    MOTION_STEPS,
    V0_CONTROL_HZ,
    PolicyActionWrapper,
    make_env_kwargs,
)
from robocas_ms3.evaluation.rollouts.rollout import EndConditions, EpisodeBatch, run_rollouts
from robocas_ms3.robots.registry import find_robot
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.vector import RoboCASVectorEnv

PROTOCOL = "paper-v1"
_STEPS_STREAM = 410  # random stream of the number of steps
_log = logging.getLogger(__name__)


def sample_roll_in_steps(seed: int, after_steps: tuple[int, int]) -> int:
    """Return the number of policy steps for a seed, uniform in ``after_steps`` (both ends included)."""
    return int(np.random.default_rng([seed, _STEPS_STREAM]).integers(after_steps[0], after_steps[1] + 1))


def check_roll_in_policy(settings: EpisodeSettings) -> str:
    """Check that the policy ``after_policy`` fits `PROTOCOL`; return the hash of its weights, empty without weights."""
    with open_policy(settings.after_policy) as policy:
        load_protocol(PROTOCOL).rules.check_policy(policy.spec)
        if (check_robot := getattr(policy, "check_robot", None)) is not None:
            check_robot(settings.robot)
        if policy.spec.cameras:
            robot = find_robot(settings.robot).description
            check_cameras(policy.spec, load_task_config(settings.config), robot, settings.config)
            require_renderer()
        return str(getattr(policy, "describe", dict)().get("weights", ""))


class PolicyRollIn:
    """Worker (`core.workers.Worker`) that runs a policy for some steps in the scene of a seed, in one environment."""

    def __init__(self, settings: EpisodeSettings) -> None:
        self._settings, self._stack = settings, ExitStack()
        self._policy: Policy = self._stack.enter_context(open_policy(settings.after_policy))
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
        folder = self._stack.enter_context(tempfile.TemporaryDirectory(prefix="robocas-config-"))
        self._config = Path(folder) / "config.yaml"  # policies expect a file
        config = load_task_config(settings.config).model_dump(mode="json")
        self._config.write_text(json.dumps(config), encoding="utf-8")

    def run(self, seed: int) -> Intervention:
        """Run the policy in the scene of a seed; return the state of the scene after its steps.

        The result has a ``skip_reason`` if no demonstration can start: no layout, success, failure, or an error.
        """
        settings, steps = self._settings, sample_roll_in_steps(seed, self._settings.after_steps)
        batch = EpisodeBatch(self._vector, self._policy.spec, EndConditions(steps), 1 / V0_CONTROL_HZ, refill=False)
        try:
            self._vector.reset(seed=[seed])
            (ended,) = run_rollouts(batch, self._policy, [self._make_episode_spec(seed)])
        except LayoutError:
            return Intervention(seed, settings.after_policy, 0, {}, 1.0, "no_layout")
        if ended.error:
            _log.warning("seed %d is skipped: the policy failed: %s", seed, ended.error)
        reasons = {
            "policy_failed": ended.error,
            "succeeded": ended.at_end["success"],
            "failed": ended.at_end["fail"],
        }
        skip_reason = next((reason for reason, applies in reasons.items() if applies), "")
        state: dict[str, Any] = self._base.get_state_dict()
        state = {kind: to_numpy(values) for kind, values in state.items() if kind != "controller"}
        gripper = 1.0 if self._env.is_gripper_commanded_open else -1.0
        return Intervention(seed, settings.after_policy, ended.steps, state, gripper, skip_reason)

    def close(self) -> None:
        self._env.close()
        self._stack.close()

    def _make_episode_spec(self, seed: int) -> EpisodeSpec:
        settings, text = self._settings, self._base.instruction().text
        files = (str(self._config), settings.layouts, settings.pack)
        robot, motion_steps = settings.robot, MOTION_STEPS["upstream"]
        return EpisodeSpec(-1, 0, settings.task, *files, seed, text, robot=robot, motion_steps=motion_steps)
