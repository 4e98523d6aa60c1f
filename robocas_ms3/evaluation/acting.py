"""A policy acts for a while, and leaves its state to the scripted one: where demonstrations of DAgger begin.

It acts as in `PROTOCOL`: upstream's steps at 5 Hz, its rules of what a policy may want, in scenes of any configuration.
"""

from __future__ import annotations

import json
import logging
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from robocas_ms3.core.errors import LayoutError
from robocas_ms3.datasets.writing.render import require_renderer
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.demos.takeover import Takeover
from robocas_ms3.evaluation.policies import open_policy
from robocas_ms3.evaluation.policy import EpisodeSpec, Policy, PolicySpec
from robocas_ms3.evaluation.protocol import load_protocol
from robocas_ms3.evaluation.rollout import EndConditions, EpisodeBatch, rollout
from robocas_ms3.evaluation.stepping import UPSTREAM_HZ, PolicyStepping, env_kwargs
from robocas_ms3.scenes.config import load_task_config
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.vector import NumpyVectorEnv, RoboCASVectorEnv

PROTOCOL = "paper-v1"
_STEPS = 410  # stream of an episode's seed
_log = logging.getLogger(__name__)


def steps_of(seed: int, after_steps: tuple[int, int]) -> int:
    """For how many steps a policy acts in the scene of a seed: uniform, both ends included."""
    return int(np.random.default_rng([seed, _STEPS]).integers(after_steps[0], after_steps[1] + 1))


def check_acting(settings: EpisodeSettings) -> str:
    """See that the policy named there can act; it is made once for that. Gives a hash of its weights, if it has some.

    Raises:
        RobocasError: there is no such policy, it speaks another way, or wants to see where nothing can be rendered.
    """
    with open_policy(settings.after_policy) as policy:
        load_protocol(PROTOCOL).rules.check_policy(policy.spec)
        if policy.spec.cameras:
            require_renderer()
        return str(getattr(policy, "describe", dict)().get("weights", ""))


@dataclass(frozen=True)
class Players:
    """Opens a player: one environment and one policy of its own (`core.workers.Worker`).

    Attributes:
        settings: of the demonstrations.
    """

    settings: EpisodeSettings

    def __call__(self) -> Player:
        """Open it."""
        return Player(self.settings)


class Player:
    """Has a policy act in scenes, one after the other.

    Args:
        settings: of the demonstrations.
    """

    def __init__(self, settings: EpisodeSettings) -> None:
        self._settings, self._open = settings, ExitStack()
        self._policy: Policy = self._open.enter_context(open_policy(settings.after_policy))
        self._env = _make_env(settings, self._policy.spec)
        self._base: Any = self._env.unwrapped
        vector = RoboCASVectorEnv(self._env, auto_reset=False, ignore_terminations=True, record_metrics=False)
        self._vector = NumpyVectorEnv(vector)
        self._config = self._file_of(settings.config)

    def run(self, seed: int) -> Takeover:
        """What the policy leaves in the scene of a seed."""
        settings, steps = self._settings, steps_of(seed, self._settings.after_steps)
        batch = EpisodeBatch(self._vector, self._policy.spec, EndConditions(steps), 1 / UPSTREAM_HZ, refill=False)
        try:
            self._vector.reset(seed=[seed])
            (played,) = rollout(batch, self._policy, [self._start(seed)])
        except LayoutError:
            return Takeover(seed, settings.after_policy, 0, {}, 1.0, "no_layout")
        if played.error:
            _log.warning("seed %d: %s", seed, played.error)
        refused = "policy_failed" if played.error else _over(played.at_end)
        state = {kind: _of_one_env(of) for kind, of in self._base.get_state_dict().items() if kind != "controller"}
        gripper = 1.0 if self._env.gripper_open else -1.0
        return Takeover(seed, settings.after_policy, played.steps, state, gripper, refused)

    def close(self) -> None:
        """Close environment and policy."""
        self._env.close()
        self._open.close()

    def _start(self, seed: int) -> EpisodeSpec:
        settings = self._settings
        words = self._base.instructions.of(0).text
        return EpisodeSpec(
            -1, 0, settings.task, self._config, settings.layouts, settings.pack, seed, words, robot=settings.robot
        )

    def _file_of(self, config: str | dict[str, Any]) -> str:
        """Write a resolved configuration to a file and return its path, which policies get."""
        folder = self._open.enter_context(tempfile.TemporaryDirectory(prefix="robocas-config-"))
        path = Path(folder) / "config.yaml"
        path.write_text(json.dumps(load_task_config(config).model_dump(mode="json")), encoding="utf-8")
        return str(path)


def _make_env(settings: EpisodeSettings, spec: PolicySpec) -> PolicyStepping:
    """One env in this process, as `EvaluationSession` opens several in other processes."""
    env = gym.make(
        TASKS[settings.task].env_id,
        config=settings.config,
        layouts=settings.layouts,
        pack=settings.pack,
        robot_uids=settings.robot,
        sim_backend="physx_cpu",
        **env_kwargs(spec, UPSTREAM_HZ),
    )
    return PolicyStepping(env, spec, "upstream")


def _over(at_end: dict[str, bool]) -> str:
    """Why nothing is left to do; empty: something is."""
    return next((what for flag, what in (("success", "succeeded"), ("fail", "failed")) if at_end[flag]), "")


def _of_one_env(node: Any) -> Any:
    """Nested tensors (1, ...) as arrays of the same shape."""
    return {key: _of_one_env(value) for key, value in node.items()} if isinstance(node, dict) else node.cpu().numpy()
