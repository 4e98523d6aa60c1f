"""Tries a demonstration's own actions while it is made: open loop, as a dataset will hold them, clean and with noise.

Each trial is a world of its own, in which the actions of the recording are played as far as it has come, part by part.
So what a robot would do otherwise shows where it begins, and only that part has to be done again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import EpisodeLost
from robocas_ms3.demos.ledger import NOISY
from robocas_ms3.demos.open_loop import OpenLoop, draw_noise
from robocas_ms3.demos.recordings.motion import Motion, sample_states, sample_stride
from robocas_ms3.demos.settings import EpisodeSettings
from robocas_ms3.demos.takeover import Takeover

# m by which the target may be off the recording at the end of a part. What else lies about may roll elsewhere: where
# that matters, what comes next goes wrong, and shows it.
PARTED = 0.02

States = dict[str, dict[str, NDArray[np.float32]]]


class Trials:
    """Environments that follow a recording: the first one plays the actions as they are, the others with noise."""

    def __init__(self, worlds: Sequence[OpenLoop], settings: EpisodeSettings) -> None:
        self._worlds, self._settings = worlds, settings
        self._stride = sample_stride(settings.control_freq, worlds[0].rate_hz)
        self._robot = worlds[0].env.robot_spec
        self._seed, self._played = 0, 0

    def reset(self, seed: int, takeover: Takeover | None = None) -> None:
        """Build the episode's scene in each world, as it was taken over, if it was."""
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
            EpisodeLost: ``clipped``, an action goes beyond the range of ``pd_ee_delta_pose``; ``parted``, the target is
                elsewhere than recorded; ``no_success``; with noise ``NOISY`` and the same.
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
                raise EpisodeLost("replay", f"{NOISY}{reason}" if number else reason)
        self._played += len(actions)

    def _with_noise(self, actions: NDArray[np.float64], number: int) -> NDArray[np.float64]:
        # drawn from the first action on, so that an action's noise is the same however often it is played
        rng = np.random.default_rng([self._seed, number])
        std = self._settings.noise_mm, self._settings.noise_deg
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
