"""The demonstrator in the evaluation's own loop."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.demos.episode import EpisodeGenerator, EpisodeSettings
from robocas_ms3.evaluation.policies.tracks import Followers, Track
from robocas_ms3.evaluation.policy import Observations, Start, Wants
from robocas_ms3.robots.constants import ARM_REST


class ScriptedPolicy:
    """Plans each episode in an environment of its own, by what only a simulator knows, and does it again here.

    What it scores is what the scripted policies and their planner can do, in the very loop that learned policies are
    measured in. An episode for which no demonstration is found is played standing still. Its base does not drive.
    """

    wants = Wants(convention="joint_positions", rate_hz=20, language="none")

    def __init__(self) -> None:
        self._generators: dict[str, EpisodeGenerator] = {}
        self._followers = Followers(np.array([*ARM_REST, 1.0]), motions=False)

    def reset(self, starts: list[Start]) -> None:
        """Plan the episodes; seconds each."""
        for start in starts:
            self._followers.begin(start.env, self._plan(start))

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """(E, 8) joint targets."""
        return self._followers.next(observations)

    def _plan(self, start: Start) -> Track | None:
        generator = self._generators.get(start.config_file)
        if generator is None:
            settings = EpisodeSettings(
                start.task, start.config_file, start.pack, replay_rate=0, layouts=start.layouts_file
            )
            generator = self._generators[start.config_file] = EpisodeGenerator(settings)
        with tempfile.TemporaryDirectory() as folder:
            result = generator.generate(start.seed, Path(folder), "episode")
            if not result.success:
                return None
            with h5py.File(Path(folder) / "episode.h5") as file:
                group: Any = file["traj_0"]
                return Track(np.array(group["actions"])[:, :8])

    def close(self) -> None:
        """Close the environments that it plans in."""
        for generator in self._generators.values():
            generator.close()
