"""The demonstrator in the evaluation's own loop."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.recordings.motion import sample_stride
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.evaluation.policies.tracks import Followers, JointTrack, PoseTrack, Track
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.robots.table import find_robot
from robocas_ms3.scenes.task_specs import TASKS

BESIDE = (0.01, 0.05)  # m sideways, least and most: a finger on top of what is meant, or what stands next to it
_FREQ = 20  # Hz, at which it plans
_MAX_GENERATORS = 4  # environments that are open at a time
_BESIDE = 411  # stream of an episode's seed


class ScriptedPolicy:
    """Plans each episode in an environment of its own, by what only a simulator knows, and does it again here.

    What it scores is what the scripted policies and their planner can do, in the very loop that learned policies are
    measured in. An episode for which no demonstration is found is played standing still. Its base does not drive.

    Args:
        speaks: joint targets at 20 Hz, as it planned them; or RoboCAS' motions from where the TCP is, at 5 Hz.
        beside: those motions are off sideways, as those of a policy that does not see well: see `beside`.
    """

    def __init__(
        self, speaks: Literal["joint_positions", "robocas"] = "joint_positions", *, beside: bool = False
    ) -> None:
        self._beside = beside
        self.spec = PolicySpec(
            speaks, reference="tcp", rate_hz=20 if speaks == "joint_positions" else 5, language="none"
        )
        self._generators: dict[EpisodeSettings, EpisodeGenerator] = {}  # the one used last is the last
        self._followers = Followers()

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Plan the episodes; seconds each."""
        for start in starts:
            self._followers.begin(start.env, self._plan(start))

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """(E, A) actions of what it speaks."""
        return self._followers.act(observations)

    def _plan(self, start: EpisodeSpec) -> Track:
        generator = self._generator_of(start)
        actions, states = np.zeros((0, 8)), np.zeros((1, 37))
        with tempfile.TemporaryDirectory() as folder:
            if generator.generate(start.seed, Path(folder), "episode").success:
                with h5py.File(Path(folder) / "episode.h5") as file:
                    group: Any = file["traj_0"]
                    actions = np.array(group["actions"])[:, :8]
                    states = np.array(group["env_states"]["articulations"][start.robot])
        if self.spec.convention == "joint_positions":
            return JointTrack(actions)
        if not len(actions):
            return PoseTrack(np.zeros((0, 4, 4)), np.zeros(0, dtype=bool))
        track = PoseTrack.of(find_robot(start.robot), states, actions[:, 7], sample_stride(_FREQ, 5))
        if self._beside:
            track.poses[:, :2, 3] += beside(start.seed)
        return track

    def _generator_of(self, start: EpisodeSpec) -> EpisodeGenerator:
        """Return the generator of a start's scenes; of several the one used longest ago is closed.

        Raises:
            EvaluationError: the start does not name files of this machine, as of a client of a server.
            ExtensionError: it names a task or a robot that this machine lacks.
        """
        for name in ("config_file", "layouts_file", "pack"):
            if not getattr(start, name):
                what, fix = (
                    "unknown configuration or scene",
                    "Start the server with --protocol FOLDER.",
                )
                expected = "a file of a shipped protocol, or of one that the server was started with"
                raise EvaluationError(what, where=f"start.{name}", expected=expected, fix=fix)
        TASKS.find(start.task, where="start.task")
        find_robot(start.robot, where="start.robot")
        settings = EpisodeSettings(
            start.task,
            start.config_file,
            start.pack,
            control_freq=_FREQ,
            replay_rate=0,
            layouts=start.layouts_file,
            robot=start.robot,
        )
        generator = self._generators.pop(settings, None) or EpisodeGenerator(settings)
        self._generators[settings] = generator
        if len(self._generators) > _MAX_GENERATORS:
            self._generators.pop(next(iter(self._generators))).close()
        return generator

    def close(self) -> None:
        """Close the environments that it plans in."""
        for generator in self._generators.values():
            generator.close()


def beside(seed: int) -> NDArray[np.floating]:
    """(2,) m in the arm's base frame, of which an episode's poses are off: anywhere, by as much as `BESIDE` says."""
    generator = np.random.default_rng([seed, _BESIDE])
    angle, far = generator.uniform(0, 2 * np.pi), generator.uniform(*BESIDE)
    return far * np.array([np.cos(angle), np.sin(angle)])
