"""Plays 7-D dataset actions open loop at a dataset's rate, and checks a demonstration's own actions while it is made.

Each check (`Trials`) is an environment of its own that plays the actions of the recording so far, part by part, clean
or with noise. So only the part after which the outcome differs has to be done again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robocas_ms3.tasks  # noqa: F401  (registers the environments)
from robocas_ms3.core.errors import DatasetError, UnrecoverableError
from robocas_ms3.demos.failures import NOISY, Takeover
from robocas_ms3.demos.recordings.environment import RecordedEnv
from robocas_ms3.demos.recordings.motion import Array, Motion, sample_states, sample_stride
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.robots.ee_deltas import to_ee_delta_action
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.tasks.base import RoboCASEnv

CONTROL_MODE = "pd_ee_delta_pose"
SETTLE_SECONDS = 1.0  # after the last action, held still: what was let go comes to rest
# m by which the target may be off the recording at the end of a part; other objects that roll elsewhere show later
PARTED = 0.02

States = dict[str, dict[str, NDArray[np.float32]]]


@dataclass(frozen=True)
class Playback:
    """Result of playing an episode's actions.

    Attributes:
        success: whether the task succeeded, at some step or within ``SETTLE_SECONDS`` after the last one.
        tcp_in_base: (T, 3) m, of the TCP in the arm's base frame.
        clipped: actions with a component of the translation, or the norm of the rotation, outside [-1, 1].
    """

    success: bool
    tcp_in_base: Array
    clipped: int


class OpenLoop:
    """An environment that takes dataset actions at a rate, a whole number that divides the rate of physics.

    Attributes:
        success: whether the task has succeeded at some step since the reset.
        clipped: actions since then that were beyond what one step may do.

    Raises:
        DatasetError: no such rate or environment.
    """

    def __init__(self, env: RecordedEnv, rate_hz: float) -> None:
        if rate_hz < 1 or rate_hz != int(rate_hz) or 100 % int(rate_hz):
            expected = "a whole number that divides 100"
            raise DatasetError(
                "actions can't be played at this rate", where="rate_hz", expected=expected, found=rate_hz
            )
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

    def begin_at(self, state: dict[str, Any], gripper: float) -> None:
        """Continue from another state (as ``set_state_dict`` takes it), and the gripper's last command, -1 or 1."""
        self.env.set_state_dict(state)
        self._gripper = gripper

    def step(self, action: NDArray[np.floating]) -> None:
        """Play one action (7,), see `motion.stored_actions`."""
        wanted = np.asarray(action, dtype=np.float64)
        motion = to_ee_delta_action(wanted[:3], wanted[3:6], euler="xyz")
        self.clipped += bool(np.abs(motion[:3]).max() > 1 or np.linalg.norm(motion[3:]) > 1)
        self._gripper = 1.0 if wanted[6] > 0.5 else -1.0
        self._step(np.append(np.clip(motion, -1, 1), self._gripper))

    def settle(self) -> bool:
        """Hold still until the task has succeeded, ``SETTLE_SECONDS`` at most; gives whether it has."""
        for _ in range(round(SETTLE_SECONDS * self.rate_hz)):
            if self.success:
                break
            self._step(np.append(np.zeros(6), self._gripper))
        return self.success

    def _step(self, action: NDArray[np.floating]) -> None:
        *_, info = self._env.step(action.astype(np.float32))
        self.success |= bool(info["success"][0])

    def play(self, dataset_actions: NDArray[np.floating]) -> Playback:
        """Play actions (S, 7) from the reset on; see `motion.stored_actions`, whose last row is left out."""
        places = [self.tcp_in_base()]
        for action in np.asarray(dataset_actions, dtype=np.float64).reshape(-1, 7):
            self.step(action)
            places.append(self.tcp_in_base())
        self.settle()
        return Playback(self.success, np.stack(places).astype(np.float64), self.clipped)

    def close(self) -> None:
        self._env.close()


def draw_noise(rng: np.random.Generator, count: int, std_mm: float, std_deg: float) -> Array:
    """Draw the noise (count, 7) of a robot to add to dataset actions: normal, each component by itself."""
    drawn = np.zeros((count, 7))
    drawn[:, :6] = rng.normal(size=(count, 6)) * np.repeat([std_mm / 1000, np.deg2rad(std_deg)], 3)
    return drawn


class Trials:
    """Environments that follow a recording: the first one plays the actions as they are, the others with noise."""

    def __init__(self, worlds: Sequence[OpenLoop], settings: EpisodeSettings) -> None:
        self._worlds, self._settings = worlds, settings
        self._stride = sample_stride(settings.control_freq, worlds[0].rate_hz)
        self._robot = worlds[0].env.robot_spec
        self._seed, self._played = 0, 0

    def reset(self, seed: int, takeover: Takeover | None = None) -> None:
        for world in self._worlds:
            world.reset(seed)
            if takeover is not None:
                world.begin_at(takeover.state, takeover.gripper)
        self._seed, self._played = seed, 0

    def follow(
        self, states: States, gripper: NDArray[np.floating], *, finished: bool = False, noisy: bool = True
    ) -> None:
        """Play what was recorded since the last call, and compare.

        Args:
            states: ManiSkill's, after the reset and after each control step; see ``EpisodeRecorder.states``.
            gripper: (S,) its commands.
            finished: the recording has ended: the last action may be a shorter one, and the task must succeed.
            noisy: play it with noise too; without, those environments stay behind.

        Raises:
            UnrecoverableError: ``clipped``, ``parted`` (the target is elsewhere than recorded) or ``no_success``; with
                noise ``NOISY`` and the same.
        """
        samples = sample_states(len(gripper), self._stride)
        if not finished:
            samples = samples[samples % self._stride == 0]
        new = samples[self._played :]
        recorded = states["articulations"][self._robot.description.uid]
        actions = Motion.of(self._robot, recorded, gripper, new).actions[:-1].astype(np.float64)
        for number, world in enumerate(self._worlds if noisy else self._worlds[:1]):
            for action in self._with_noise(actions, number) if number else actions:
                world.step(action)
            reason = _what_is_wrong(world, states, int(new[-1]), finished)
            if reason:
                raise UnrecoverableError("replay", f"{NOISY}{reason}" if number else reason)
        self._played += len(actions)

    def _with_noise(self, actions: NDArray[np.float64], number: int) -> NDArray[np.float64]:
        # drawn from the first action on, so that an action's noise is the same however often it is played
        rng = np.random.default_rng([self._seed, number])
        std = self._settings.check_noise_mm, self._settings.check_noise_deg
        return actions + draw_noise(rng, self._played + len(actions), *std)[self._played :]


def _what_is_wrong(world: OpenLoop, states: States, sample: int, finished: bool) -> str:
    if world.clipped:
        return "clipped"
    if finished:
        return "" if world.settle() else "no_success"
    target = int(world.env.target_slot[0])
    recorded = states["actors"][world.env.objects[target].name][sample, :3]
    off = np.linalg.norm(world.env.object_poses[0, target, :3].numpy() - recorded)
    return "parted" if off > PARTED else ""
