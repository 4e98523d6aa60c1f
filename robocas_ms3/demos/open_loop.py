"""Are a demonstration's own actions enough? Plays 7-D dataset actions open loop, at a dataset's rate."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

import robocas_ms3.tasks  # noqa: F401  (registers the environments)
from robocas_ms3.demos.sampling import (
    Array,
    gripper_open,
    invert,
    sample_states,
    sample_stride,
    split_states,
    stored_actions,
    stored_motion,
)
from robocas_ms3.errors import DatasetError
from robocas_ms3.robots.constants import FINGER_SLICE, FINGER_TARGETS
from robocas_ms3.robots.controllers import to_ee_delta_action
from robocas_ms3.robots.forward import link_poses
from robocas_ms3.scenes.layout import Layout
from robocas_ms3.tasks.base import RoboCASEnv

CONTROL_MODE = "pd_ee_delta_pose"
SETTLE_SECONDS = 1.0  # after the last action, held still: what was let go comes to rest
NOISE = 1e-5  # m; a dataset's rounding alone makes some heaps fall otherwise
DIVERGED = 0.01  # m that an object may be off the recording
_OTHERWISE = ("control_mode", "obs_mode", "reward_mode", "render_backend", "render_mode", "sim_backend", "num_envs")


@dataclass(frozen=True)
class Played:
    """What came of an episode's actions.

    Attributes:
        success: whether the task succeeded, at some step or within ``SETTLE_SECONDS`` after the last one.
        tcp_in_base: (T, 3) m, where the TCP was, in the arm's base frame.
        clipped: actions beyond what one step may do: a component of the translation, or the norm of the rotation,
            outside [-1, 1].
        objects: name -> (T, 3) m, where each actor was in the world.
    """

    success: bool
    tcp_in_base: Array
    clipped: int
    objects: dict[str, NDArray[np.float32]] = field(default_factory=dict)

    def parted_at(self, recorded: dict[str, NDArray[np.float32]]) -> int:
        """First step at which an object was more than ``DIVERGED`` off a recording, (T, 13) each; T where none was."""
        steps = len(self.tcp_in_base)
        apart = np.zeros(steps)
        for name, places in self.objects.items():
            apart = np.maximum(apart, np.linalg.norm(places - recorded[name][:steps, :3], axis=1))
        return int(np.argmax(apart > DIVERGED)) if (apart > DIVERGED).any() else steps


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
        self.rate_hz = int(rate_hz)

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

    def play(self, dataset_actions: NDArray[np.floating]) -> Played:
        """Play actions (S, 7) from the reset on; see `sampling.stored_actions`, whose last row is left out."""
        env = self.env.unwrapped
        assert isinstance(env, RoboCASEnv)
        wanted = np.asarray(dataset_actions, dtype=np.float64).reshape(-1, 7)
        motion = to_ee_delta_action(wanted[:, :3], wanted[:, 3:6], euler="xyz")
        beyond = (np.abs(motion[:, :3]) > 1).any(axis=1) | (np.linalg.norm(motion[:, 3:], axis=1) > 1)
        actions = np.column_stack([np.clip(motion, -1, 1), np.where(wanted[:, 6] > 0.5, 1, -1)]).astype(np.float32)
        places, objects, success = [env.agent.tcp_in_arm_base.p[0].numpy().copy()], [_objects(env)], False
        for action in actions:
            *_, info = self.env.step(action)
            places.append(env.agent.tcp_in_arm_base.p[0].numpy().copy())
            objects.append(_objects(env))
            success |= bool(info["success"][0])
        still = np.append(np.zeros(6), actions[-1, 6] if len(actions) else 1).astype(np.float32)
        for _ in range(round(SETTLE_SECONDS * self.rate_hz)):
            if success:
                break
            *_, info = self.env.step(still)
            success |= bool(info["success"][0])
        moved = {name: np.stack([at[name] for at in objects]) for name in objects[0]}
        return Played(success, np.stack(places).astype(np.float64), int(beyond.sum()), moved)

    def play_recording(
        self,
        seed: int,
        robot_states: NDArray[np.floating],
        gripper: NDArray[np.floating],
        control_freq: float,
        noise: np.random.Generator | None = None,
    ) -> Played:
        """Play what a dataset of this rate will hold of a recording, to the last bit.

        Args:
            seed: of the episode.
            robot_states: (S + 1, 37) after the reset and after each control step.
            gripper: (S,) commands in [-1, 1].
            control_freq: of the recording, Hz.
            noise: source of noise of ``NOISE`` that is added to each action's translation; default: none.
        """
        samples = sample_states(len(gripper), sample_stride(control_freq, self.rate_hz))
        root_in_world, qpos, _ = split_states(robot_states[samples])
        tcp, base = link_poses(root_in_world, qpos)
        width = float(qpos[0, FINGER_SLICE].sum())
        status = gripper_open(gripper, samples, finger_range=FINGER_TARGETS, initial_width=width)
        actions = stored_actions(*stored_motion(invert(base) @ tcp), status)[:-1].astype(np.float64)
        if noise is not None:
            actions[:, :3] += noise.normal(0, NOISE, (len(actions), 3))
        self.reset(seed)
        return self.play(actions)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def _objects(env: RoboCASEnv) -> dict[str, NDArray[np.float32]]:
    states: Any = env.get_state_dict()
    return {name: state[0, :3].numpy().copy() for name, state in states["actors"].items()}
