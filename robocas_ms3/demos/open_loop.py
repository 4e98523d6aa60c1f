"""Replay 7-D dataset actions open loop, and check demonstrations while they are recorded.

`OpenLoopChecks` replays the recorded actions in separate environments: without noise in the first environment, with
noise in the others. The check runs several times per episode, and only the actions since the last check are repeated if
a check fails.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robocas_ms3.tasks  # noqa: F401  (registers the environments)
from robocas_ms3.core.errors import DatasetError, UnrecoverableError
from robocas_ms3.demos.failures import WITH_NOISE, Intervention
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.demos.recordings.motion import Array, Motion, sample_states, sample_stride
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.planning.action_noise import draw_noise
from robocas_ms3.robots.ee_deltas import to_ee_delta_action
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.tasks.base import RoboCASEnv

CONTROL_MODE = "pd_ee_delta_pose"
SETTLE_SECONDS = 1.0  # s to hold still after the last action, until released objects are at rest
# m between the target and its recorded position at a check; deviations of other objects are detected later
MAX_TARGET_OFFSET = 0.02

States = dict[str, dict[str, NDArray[np.float32]]]


@dataclass(frozen=True)
class OpenLoopResult:
    """Result of an open-loop replay of an episode.

    Attributes:
        success: whether the task succeeded at any step or within ``SETTLE_SECONDS`` after the last step.
        tcp_in_base: (S + 1, 3) TCP positions in the arm's base frame after the reset and after each of S actions, m.
        clipped: number of actions that exceed the range of one controller step and were clipped.
    """

    success: bool
    tcp_in_base: Array
    clipped: int


class OpenLoopEnv:
    """Environment that executes 7-D dataset actions.

    Args:
        env: the recorded environment.
        rate_hz: rate of the actions, a divisor of 100, the rate of physics in Hz.

    Attributes:
        success: whether the task has succeeded at any step since the reset.
        clipped: number of actions since the reset that exceeded the range of one controller step and were clipped.

    Raises:
        DatasetError: invalid rate, or the environment is not installed.
    """

    def __init__(self, env: RecordedEnv, rate_hz: float) -> None:
        if rate_hz < 1 or rate_hz != int(rate_hz) or 100 % int(rate_hz):
            expected = "a divisor of 100 Hz, the rate of physics"
            raise DatasetError("unsupported rate of actions", where="rate_hz", expected=expected, found=rate_hz)
        self._env = env.make(
            obs_mode="none",
            reward_mode="none",
            control_mode=CONTROL_MODE,
            render_backend="none",
            sim_config={**env.kwargs.get("sim_config", {}), "control_freq": int(rate_hz)},
        )
        self.rate_hz = int(rate_hz)
        self.success, self.clipped, self._gripper = False, 0, 1.0

    @property
    def env(self) -> RoboCASEnv:
        env = self._env.unwrapped
        assert isinstance(env, RoboCASEnv)
        return env

    def reset(self, seed: int, options: dict[str, Any] | None = None) -> None:
        self._env.reset(seed=seed, options=dict(options or {}))
        self.success, self.clipped, self._gripper = False, 0, 1.0

    @property
    def layout(self) -> Layout:
        return self.env.layout()

    def tcp_in_base(self) -> NDArray[np.float32]:
        return self.env.agent.tcp_in_arm_base.p[0].numpy().copy()

    def start_at(self, state: dict[str, Any], gripper: float) -> None:
        """Set the state (argument of ``set_state_dict``) and the last gripper command, -1 closed or 1 open."""
        self.env.set_state_dict(state)
        self._gripper = gripper

    def step(self, action: NDArray[np.floating]) -> None:
        """Execute one dataset action (7,), a row of `motion.to_dataset_actions`."""
        action = np.asarray(action, dtype=np.float64)
        motion = to_ee_delta_action(action[:3], action[3:6], euler="xyz")
        self.clipped += bool(np.abs(motion[:3]).max() > 1 or np.linalg.norm(motion[3:]) > 1)
        self._gripper = 1.0 if action[6] > 0.5 else -1.0
        self._step(np.append(np.clip(motion, -1, 1), self._gripper))

    def settle(self) -> bool:
        """Hold still until the task succeeds, at most ``SETTLE_SECONDS``; return whether it succeeded."""
        for _ in range(round(SETTLE_SECONDS * self.rate_hz)):
            if self.success:
                break
            self._step(np.append(np.zeros(6), self._gripper))
        return self.success

    def _step(self, action: NDArray[np.floating]) -> None:
        *_, info = self._env.step(action.astype(np.float32))
        self.success |= bool(info["success"][0])

    def replay(self, dataset_actions: NDArray[np.floating]) -> OpenLoopResult:
        """Replay S dataset actions (S, 7) from the reset on.

        The actions are the rows of `motion.to_dataset_actions` without the last row.
        """
        positions = [self.tcp_in_base()]
        for action in np.asarray(dataset_actions, dtype=np.float64).reshape(-1, 7):
            self.step(action)
            positions.append(self.tcp_in_base())
        self.settle()
        return OpenLoopResult(self.success, np.stack(positions).astype(np.float64), self.clipped)

    def close(self) -> None:
        self._env.close()


class OpenLoopChecks:
    """Environments that replay a recording while it grows, the first without noise, the others with noise.

    Args:
        envs: one environment without noise, followed by one environment per noise check.
        settings: settings of the episodes.
    """

    def __init__(self, envs: Sequence[OpenLoopEnv], settings: EpisodeSettings) -> None:
        self._envs, self._settings = envs, settings
        self._stride = sample_stride(settings.control_freq, envs[0].rate_hz)
        self._robot = envs[0].env.robot_spec
        self._seed, self._replayed = 0, 0

    def reset(self, seed: int, intervention: Intervention | None = None) -> None:
        for env in self._envs:
            env.reset(seed)
            if intervention is not None:
                env.start_at(intervention.state, intervention.gripper)
        self._seed, self._replayed = seed, 0

    def check(
        self, states: States, gripper: NDArray[np.floating], *, finished: bool = False, noise: bool = True
    ) -> str:
        """Replay the actions recorded since the last call and compare the result with the recording.

        Args:
            states: ``EpisodeRecorder.states``: states after the reset and after each control step.
            gripper: (S,) gripper commands of all control steps since the reset, -1 closed or 1 open.
            finished: whether the recording is complete; then the last action may be shorter, and the task must succeed.
            noise: whether to replay with noise too.

        Returns:
            Empty text, or the reason why a replay with noise fails, with the suffix ``WITH_NOISE``. The replays with
            noise then do not continue: pass ``noise=False`` from now on.

        Raises:
            UnrecoverableError: the replay without noise fails, for one of these reasons.
                ``clipped``: an action exceeds the range of one controller step.
                ``target_displaced``: the target is more than ``MAX_TARGET_OFFSET`` from its recorded position.
                ``no_success``: the task does not succeed at the end.
        """
        samples = sample_states(len(gripper), self._stride)
        if not finished:
            samples = samples[samples % self._stride == 0]
        new = samples[self._replayed :]
        recorded = states["articulations"][self._robot.description.uid]
        actions = Motion.from_states(self._robot, recorded, gripper, new).actions[:-1].astype(np.float64)
        failure = ""
        for number, env in enumerate(self._envs if noise else self._envs[:1]):
            for action in self._add_noise(actions, number) if number else actions:
                env.step(action)
            reason = _find_deviation(env, states, int(new[-1]), finished)
            if reason and not number:
                raise UnrecoverableError("open_loop_check", reason)
            if reason:
                failure = f"{reason}{WITH_NOISE}"
                break
        self._replayed += len(actions)
        return failure

    def _add_noise(self, actions: NDArray[np.float64], number: int) -> NDArray[np.float64]:
        # drawn from the first action on, so that the noise of an action does not depend on the number of checks
        rng = np.random.default_rng([self._seed, number])
        std = self._settings.check_noise_mm, self._settings.check_noise_deg
        return actions + draw_noise(rng, self._replayed + len(actions), *std)[self._replayed :]


def _find_deviation(env: OpenLoopEnv, states: States, sample: int, finished: bool) -> str:
    """Return the reason why the replay in ``env`` fails, or an empty string."""
    if env.clipped:
        return "clipped"
    if finished:
        return "" if env.settle() else "no_success"
    target = int(env.env.target_slot[0])
    recorded = states["actors"][env.env.objects[target].name][sample, :3]
    offset = np.linalg.norm(env.env.object_poses[0, target, :3].numpy() - recorded)
    return "target_displaced" if offset > MAX_TARGET_OFFSET else ""
