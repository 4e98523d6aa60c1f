"""Tries a demonstration's own actions before it counts: open loop, as a dataset holds them."""

from __future__ import annotations

import numpy as np

from robocas_ms3.demos.open_loop import OpenLoop
from robocas_ms3.demos.record import EpisodeRecorder
from robocas_ms3.demos.sampling import sample_states, sample_stride
from robocas_ms3.errors import EpisodeLost
from robocas_ms3.planning.executor import Executor
from robocas_ms3.robots.constants import ROBOT_UID

TRIALS = 2  # as they are, and with noise that any robot has


def try_actions(open_loop: OpenLoop, executor: Executor, recorder: EpisodeRecorder, control_freq: float) -> None:
    """Play what was done since the reset, several times.

    Where that goes wrong, checkpoints after the moment at which objects went other ways than recorded are forgotten:
    the cause lies before them.

    Args:
        open_loop: of the same configuration.
        executor: what was done.
        recorder: what came of it.
        control_freq: of the recording, Hz.

    Raises:
        EpisodeLost: the actions do not succeed again, or go beyond the range of ``pd_ee_delta_pose``.
    """
    gripper = np.array([action[7] for action in executor.actions])
    states = recorder.states
    samples = sample_states(len(gripper), sample_stride(control_freq, open_loop.rate_hz))
    for trial in range(TRIALS):
        noise = np.random.default_rng([executor.seed, trial]) if trial else None
        with executor.seconds.spent_on("simulation"):
            played = open_loop.play_recording(
                executor.seed, states["articulations"][ROBOT_UID], gripper, control_freq, noise
            )
        if played.clipped:
            executor.forget_checkpoints(after=0)
            raise EpisodeLost("replay", "clipped")
        if not played.success:
            parted = played.parted_at({name: found[samples] for name, found in states["actors"].items()})
            executor.forget_checkpoints(after=int(samples[max(parted - 1, 0)]))  # the last moment that was as recorded
            raise EpisodeLost("replay", "no_success")
