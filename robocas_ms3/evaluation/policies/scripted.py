"""The scripted policy that records demonstrations, in the evaluation's loop."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.recordings.motion import sample_stride
from robocas_ms3.demos.recordings.trajectory_hdf5 import open_episode, open_trajectory, read_steps
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.evaluation.policies.replay import JointTrack, PoseTrack, TrackPolicy
from robocas_ms3.evaluation.policy import EpisodeSpec, PolicySpec
from robocas_ms3.robots.registry import find_robot
from robocas_ms3.scenes.task_specs import TASKS

OFFSETS = (0.01, 0.05)  # m sideways, least and most: a finger on top of the target, or of an object next to it
_FREQ = 20  # Hz, control rate of the plans
_MAX_GENERATORS = 4  # environments that are open at a time
_OFFSET_STREAM = 411  # of an episode's seed


class ScriptedPolicy(TrackPolicy):
    """Plan each episode in an environment of its own, with privileged state, and repeat it.

    Its score is what the scripted policies and their planner reach in the loop in which learned policies are measured.
    It does not move in an episode for which no demonstration is found. Its base does not drive.

    Args:
        convention: joint targets at 20 Hz, as planned; or RoboCAS' motions from where the TCP is, at 5 Hz.
        perturbed: shift these motions sideways (`offset`), like those of a policy that misjudges positions.
    """

    def __init__(
        self, convention: Literal["joint_positions", "robocas"] = "joint_positions", *, perturbed: bool = False
    ) -> None:
        super().__init__()
        self._perturbed = perturbed
        rate = _FREQ if convention == "joint_positions" else 5
        self.spec = PolicySpec(convention, reference="tcp", rate_hz=rate, language="none")
        self._generators: dict[EpisodeSettings, EpisodeGenerator] = {}  # the one used last is the last

    def track(self, episode: EpisodeSpec) -> JointTrack | PoseTrack:
        """Plan an episode, which takes seconds."""
        actions, states = np.zeros((0, 8)), np.zeros((1, 37))
        generator = self._generator_of(episode)
        with tempfile.TemporaryDirectory() as folder:
            if generator.generate(episode.seed, Path(folder), "episode").success:
                with open_trajectory(Path(folder) / "episode.h5") as file:
                    actions, found = read_steps(open_episode(file, 0), body=episode.robot)
                actions, states = actions[:, :8], found["articulations"][episode.robot]
        if self.spec.convention == "joint_positions":
            return JointTrack(actions)
        track = PoseTrack.from_recording(find_robot(episode.robot), states, actions[:, 7], sample_stride(_FREQ, 5))
        if self._perturbed:
            track.poses[:, :2, 3] += offset(episode.seed)
        return track

    def close(self) -> None:
        for generator in self._generators.values():
            generator.close()

    def _generator_of(self, episode: EpisodeSpec) -> EpisodeGenerator:
        """Return the generator of an episode's scenes; the one used longest ago is closed if there are too many."""
        for name in ("config_file", "layouts_file", "pack"):
            if not getattr(episode, name):
                what, fix = "unknown configuration or scene", "Start the server with --protocol FOLDER."
                expected = "a file of a shipped protocol, or of one that the server was started with"
                raise EvaluationError(what, where=f"start.{name}", expected=expected, fix=fix)
        TASKS.find(episode.task, where="start.task")
        find_robot(episode.robot, where="start.robot")
        settings = EpisodeSettings(
            episode.task,
            episode.config_file,
            episode.pack,
            control_freq=_FREQ,
            check_rate=0,
            layouts=episode.layouts_file,
            robot=episode.robot,
        )
        generator = self._generators.pop(settings, None) or EpisodeGenerator(settings)
        self._generators[settings] = generator
        if len(self._generators) > _MAX_GENERATORS:
            self._generators.pop(next(iter(self._generators))).close()
        return generator


def offset(seed: int) -> NDArray[np.floating]:
    """Return the shift (2,) of an episode's poses, m in the arm's base frame: in any direction, as far as `OFFSETS`."""
    generator = np.random.default_rng([seed, _OFFSET_STREAM])
    angle, distance = generator.uniform(0, 2 * np.pi), generator.uniform(*OFFSETS)
    return distance * np.array([np.cos(angle), np.sin(angle)])
