"""Scripted policy of the demonstrations, as a policy for evaluations."""

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

OFFSETS = (0.01, 0.05)  # smallest and largest offset in m: a finger lands on the target or on a neighbouring object
_FREQ = 20  # Hz, control rate of the plans
_MAX_GENERATORS = 4  # maximum number of open environments
_OFFSET_STREAM = 411  # random stream of the offset


class ScriptedPolicy(TrackPolicy):
    """Policy that plans a whole episode from privileged state, and then executes the plan open loop.

    The scripted policy of `robocas generate` makes the plan in a separate environment. If it finds no successful plan,
    the arm does not move. The base of the robot never moves.

    Args:
        convention: ``joint_positions``: joint targets at 20 Hz; ``robocas``: 7-D actions at 5 Hz, relative to the TCP.
        perturbed: whether to shift all TCP poses of an episode by one horizontal offset (`sample_offset`), like a
            policy that misjudges positions; only with the convention ``robocas``.
    """

    def __init__(
        self, convention: Literal["joint_positions", "robocas"] = "joint_positions", *, perturbed: bool = False
    ) -> None:
        super().__init__()
        self._perturbed = perturbed
        rate = _FREQ if convention == "joint_positions" else 5
        self.spec = PolicySpec(convention, reference="tcp", rate_hz=rate, language="none")
        self._generators: dict[EpisodeSettings, EpisodeGenerator] = {}  # most recently used last

    def make_track(self, episode: EpisodeSpec) -> JointTrack | PoseTrack:
        """Plan an episode with the scripted policy and return the planned targets; takes several seconds."""
        actions, states = np.zeros((0, 8)), np.zeros((1, 37))
        generator = self._open_generator(episode)
        with tempfile.TemporaryDirectory() as folder:
            if generator.generate(episode.seed, Path(folder), "episode").success:
                with open_trajectory(Path(folder) / "episode.h5") as file:
                    actions, found = read_steps(open_episode(file, 0), body=episode.robot)
                actions, states = actions[:, :8], found["articulations"][episode.robot]
        if self.spec.convention == "joint_positions":
            return JointTrack(actions)
        track = PoseTrack.from_recording(find_robot(episode.robot), states, actions[:, 7], sample_stride(_FREQ, 5))
        if self._perturbed:
            track.poses[:, :2, 3] += sample_offset(episode.seed)
        return track

    def close(self) -> None:
        """Close the environments in which the episodes were planned."""
        for generator in self._generators.values():
            generator.close()

    def _open_generator(self, episode: EpisodeSpec) -> EpisodeGenerator:
        """Return the generator for the configuration of an episode; open it if needed.

        If more than `_MAX_GENERATORS` generators are open, the least recently used one is closed.
        """
        for name in ("config_file", "layouts_file", "pack"):
            if not getattr(episode, name):
                what, fix = (
                    "the policy server does not have this file or pack",
                    "Start the server with --protocol FOLDER.",
                )
                expected = "a file of a bundled protocol or of a protocol that was passed to robocas serve-policy"
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


def sample_offset(seed: int) -> NDArray[np.floating]:
    """Return the horizontal offset (2,) for the seed of an episode, in m in the frame of the arm's base (`OFFSETS`)."""
    generator = np.random.default_rng([seed, _OFFSET_STREAM])
    angle, distance = generator.uniform(0, 2 * np.pi), generator.uniform(*OFFSETS)
    return distance * np.array([np.cos(angle), np.sin(angle)])
