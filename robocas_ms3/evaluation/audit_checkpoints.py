"""Audit on another model of processor: replay each part of an episode between two recorded checkpoints.

Rounding differs between processors, so that contacts diverge within seconds. The replay is therefore set to each
recorded checkpoint, after it was compared with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.evaluation.action_wrapper import CHECKPOINT
from robocas_ms3.evaluation.outcomes import Checkpoints, Outcome

POSITION_TOLERANCE = 0.05
"""m between a body in the replay and in the checkpoint."""
SECONDS_TOLERANCE = 2.0
"""Simulated time between the moments at which a stage or success was reached."""
PATH_TOLERANCE = 0.05
"""Relative difference of the path lengths of the TCP."""
COUNT_TOLERANCE = 1
"""Difference of the numbers of disturbed and of fallen objects."""


class CheckpointEnv:
    """Vector environment with one env, which is compared with recorded checkpoints and set to them.

    Args:
        env: the environment, with checkpoints in ``info``.

    Attributes:
        differences: a text for the first checkpoint of the episode that was too far away.
    """

    def __init__(self, env: Any) -> None:
        self._env, self.num_envs = env, env.num_envs
        self._positions: NDArray[np.int64] | None = None
        self._states: Mapping[int, NDArray[np.float32]] = {}
        self._step, self.differences = 0, list[str]()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def start(self, checkpoints: Checkpoints) -> None:
        """Set the checkpoints of the episode that has just started."""
        self._states = dict(zip(checkpoints.steps.tolist(), checkpoints.states, strict=True))
        self._step, self.differences = 0, []

    def step(self, actions: Any) -> Any:
        result = self._env.step(actions)
        self._step += 1
        state = self._states.get(self._step)
        if state is None or self.differences:
            return result
        if self._positions is None:
            self._positions = self._env.call("find_position_columns")[0]
        reached = np.asarray(result[-1][CHECKPOINT])[0]
        if reached.shape != state.shape:
            self.differences = [f"checkpoints: {len(state)} numbers per state -> {len(reached)}"]
            return result
        distance = np.linalg.norm(reached[self._positions] - state[self._positions], axis=1).max()
        if distance > POSITION_TOLERANCE:
            self.differences = [f"checkpoints: a body is {distance:.3f} m away after step {self._step}"]
        self._env.call("restore", state[None], stages=False)
        return result


def list_differences_within_tolerance(recorded: Outcome, replayed: Outcome) -> list[str]:
    """Return a text per value of a recorded outcome that differs from the replay by more than its tolerance.

    The impulse of contacts and the retrieval order are not compared.
    """
    found = []
    for name in ("success", "success_v0"):
        if getattr(recorded, name) != getattr(replayed, name):
            found.append(f"{name}: {getattr(recorded, name)} -> {getattr(replayed, name)}")
    for name, second in recorded.flag_seconds.items():
        now = replayed.flag_seconds.get(name)
        if not _are_close(second, now, max(recorded.seconds, replayed.seconds)):
            found.append(f"flag_seconds.{name}: {second} -> {now}")
    paths = [one.measures.get("path_length", np.inf) for one in (recorded, replayed)]
    if abs(paths[0] - paths[1]) > PATH_TOLERANCE * max(paths):
        found.append(f"measures.path_length: {paths[0]} -> {paths[1]}")
    for name in ("disturbed_most", "fallen"):
        counts = [one.measures.get(name, np.inf) for one in (recorded, replayed)]
        if abs(counts[0] - counts[1]) > COUNT_TOLERANCE:
            found.append(f"measures.{name}: {counts[0]} -> {counts[1]}")
    return found


def _are_close(second: float | None, other: float | None, end: float) -> bool:
    """Return whether two times are close; what was not reached may have been reached after the end of the episode."""
    times = [end if one is None else one for one in (second, other)]
    return abs(times[0] - times[1]) <= SECONDS_TOLERANCE
