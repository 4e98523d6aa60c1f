"""Are a demonstration's own actions enough? Plays 7-D dataset actions open loop, at a dataset's rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import robocas_ms3.tasks  # noqa: F401  (registers the environments)
from robocas_ms3.demos.sampling import Array, gripper_open, relative_motion, sample_states, sample_stride
from robocas_ms3.errors import DatasetError
from robocas_ms3.robots.constants import FINGER_TARGETS, OPEN_FINGER
from robocas_ms3.robots.controllers import to_ee_delta_action
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.tasks.base import RoboCASEnv

CONTROL_MODE = "pd_ee_delta_pose"
SETTLE_SECONDS = 1.0  # after the last action, held still: what was let go comes to rest
NOISE = 1e-5  # m; a dataset's rounding alone makes some heaps fall otherwise
_OTHERWISE = ("control_mode", "obs_mode", "reward_mode", "render_backend", "render_mode", "sim_backend", "num_envs")


@dataclass(frozen=True)
class Played:
    """What came of an episode's actions.

    Attributes:
        success: whether the task succeeded, at some step or within ``SETTLE_SECONDS`` after the last one.
        tcp_in_base: (T, 3) m, where the TCP was, in the arm's base frame.
        clipped: actions beyond what one step may do: a component of the translation, or the norm of the rotation,
            outside [-1, 1].
    """

    success: bool
    tcp_in_base: Array
    clipped: int


class OpenLoop:
    """An environment that takes dataset actions.

    Args:
        env_info: ``env_id`` and ``env_kwargs`` of the recording.
        rate_hz: of the actions; a whole number that divides the rate of physics.

    Raises:
        DatasetError: no such rate or environment.
    """

    def __init__(self, env_info: dict[str, Any], rate_hz: float) -> None:
        if rate_hz < 1 or rate_hz != int(rate_hz) or 100 % int(rate_hz):
            expected = "a whole number that divides 100"
            raise DatasetError(
                "actions can't be played at this rate", where="rate_hz", expected=expected, found=rate_hz
            )
        kwargs = {key: value for key, value in env_info["env_kwargs"].items() if key not in _OTHERWISE}
        kwargs["sim_config"] = {**kwargs.get("sim_config", {}), "control_freq": int(rate_hz)}
        torch.set_num_threads(1)
        try:
            self.env = gym.make(
                env_info["env_id"],
                obs_mode="none",
                reward_mode="none",
                control_mode=CONTROL_MODE,
                render_backend="none",
                **kwargs,
            )
        except gym.error.Error as error:
            raise DatasetError("no such environment", where=env_info["env_id"], found=str(error)) from error
        self._rate = int(rate_hz)

    def reset(self, seed: int, options: dict[str, Any] | None = None) -> None:
        """Build an episode's scene.

        Args:
            seed: of the episode.
            options: further options of its reset.
        """
        self.env.reset(seed=seed, options=dict(options or {}))

    @property
    def layout(self) -> Layout:
        """Of the scene that was built last."""
        env = self.env.unwrapped
        assert isinstance(env, RoboCASEnv)
        layout = env.layouts[0]
        assert layout is not None
        return layout

    def play(self, translations: Array, rotations: Rotation, gripper: NDArray[np.bool_]) -> Played:
        """Play actions from the reset on.

        Args:
            translations: (S, 3) m, of the TCP in its own frame.
            rotations: (S,) likewise.
            gripper: (S,) True = open.
        """
        env = self.env.unwrapped
        assert isinstance(env, RoboCASEnv)
        motion = to_ee_delta_action(translations, rotations) if len(translations) else np.zeros((0, 6), np.float32)
        beyond = (np.abs(motion[:, :3]) > 1).any(axis=1) | (np.linalg.norm(motion[:, 3:], axis=1) > 1)
        actions = np.column_stack([np.clip(motion, -1, 1), np.where(gripper, 1, -1)]).astype(np.float32)
        places, success = [env.agent.tcp_in_arm_base.p[0].numpy().copy()], False
        for action in actions:
            *_, info = self.env.step(action)
            places.append(env.agent.tcp_in_arm_base.p[0].numpy().copy())
            success |= bool(info["success"][0])
        still = np.append(np.zeros(6), actions[-1, 6] if len(actions) else 1).astype(np.float32)
        for _ in range(round(SETTLE_SECONDS * self._rate)):
            if success:
                break
            *_, info = self.env.step(still)
            success |= bool(info["success"][0])
        return Played(success, np.stack(places).astype(np.float64), int(beyond.sum()))

    def play_recording(
        self,
        seed: int,
        tcp_in_base: Array,
        gripper: NDArray[np.floating],
        control_freq: float,
        noise: np.random.Generator | None = None,
    ) -> Played:
        """Play what a dataset of this rate would hold of a recording.

        Args:
            seed: of the episode.
            tcp_in_base: (S + 1, 4, 4) after the reset and after each control step.
            gripper: (S,) commands in [-1, 1].
            control_freq: of the recording, Hz.
            noise: source of noise of ``NOISE`` that is added to each action's translation; default: none.
        """
        samples = sample_states(len(gripper), sample_stride(control_freq, self._rate))
        motion = relative_motion(tcp_in_base[samples])[:-1]
        status = gripper_open(gripper, samples, finger_range=FINGER_TARGETS, initial_width=2 * OPEN_FINGER)
        translations = motion[:, :3, 3].copy()
        if noise is not None:
            translations += noise.normal(0, NOISE, translations.shape)
        self.reset(seed)
        return self.play(translations, Rotation.from_matrix(motion[:, :3, :3]), status[1:])

    def close(self) -> None:
        """Close the environment."""
        self.env.close()
