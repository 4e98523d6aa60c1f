"""Recorded episodes, played again for their rewards, and left at any step for something else."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
from learning_envs import STATE_ONLY

import robocas_ms3  # noqa: F401
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.tasks import TASKS

OPEN, SHUT = 1.0, -1.0  # the gripper's command, the last number of an action


class Demonstration:
    """A recorded episode.

    Attributes:
        actions: (T, 8) joint positions, and the gripper's command.
        levels: (T,) of ``normalized_dense``.
        infos: T of them.
        stages: (T,) place of the stage that each step's reward is of in the task's table.
        released: the step in which the gripper lets go of the target.
    """

    def __init__(self, task: str, config: str, seed: int, folder: Path) -> None:
        generator = EpisodeGenerator(EpisodeSettings(task, config, "builtin", replay_rate=0))
        while not generator.generate(seed, folder, "demonstration").success:
            seed += 1
        generator.close()
        with h5py.File(folder / "demonstration.h5") as file:
            self.actions = np.array(file["traj_0"]["actions"])
        self.task = task
        self.env = gym.make(
            TASKS[task].env_id, config=config, obs_mode="none", reward_mode="normalized_dense", **STATE_ONLY
        )
        self.env.reset(seed=seed)
        self._states, levels, self.infos = [], [], []
        for action in self.actions:
            self._states.append(self.env.unwrapped.get_state_dict())
            _, reward, *_, info = self.env.step(action)
            levels.append(reward.item())
            self.infos.append(info)
        self.levels = np.array(levels)
        table = self.env.unwrapped.REWARDS
        full = [
            [[info["reward_terms"][name] == 1 for name in own] for own in table.stages.values()] for info in self.infos
        ]
        self.stages = np.array([[*map(all, terms), False].index(False) for terms in full])
        self.released = int(np.flatnonzero(self.actions[:, 7] < 0)[-1])

    def first(self, flag: str) -> int:
        """The step after which a flag was set for the first time."""
        return next(i for i, info in enumerate(self.infos) if info[flag][0])

    def leave(self, step: int, actions: Iterable[np.ndarray]) -> tuple[np.ndarray, list[dict]]:
        """Levels and infos of other actions from a step on, which is not done any more."""
        self.env.unwrapped.set_state_dict(self._states[step])
        levels, infos = [], []
        for action in actions:
            _, reward, *_, info = self.env.step(action)
            levels.append(reward.item())
            infos.append(info)
        return np.array(levels), infos

    def path(self, first: int, last: int, gripper: float) -> list[np.ndarray]:
        """The actions between two steps, both included, backwards if the second is the earlier one."""
        steps = range(first, last + 1) if first <= last else range(first, last - 1, -1)
        return [np.append(self.actions[step, :7], gripper).astype(np.float32) for step in steps]
