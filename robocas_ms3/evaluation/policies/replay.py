"""Recorded episodes, played again in the scenes of the same seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.demos.recordings.entries import read_json, read_reset, was_taken_over
from robocas_ms3.demos.recordings.environment import read_env
from robocas_ms3.demos.recordings.stored import open_episode, open_trajectory, read_actions
from robocas_ms3.evaluation.policies.tracks import Followers, JointTrack
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec


class ReplayPolicy:
    """Plays the actions of a trajectory file, at its own rate; an episode whose seed it lacks is played standing still.

    Args:
        trajectory: HDF5 file of joint targets (``pd_joint_pos``), its JSON beside it.

    Raises:
        EvaluationError: its actions are no joint targets.
        DatasetError: it can't be read.
    """

    def __init__(self, trajectory: Path) -> None:
        trajectory = trajectory.absolute()
        data = read_json(trajectory)
        env = read_env(data["env_info"], trajectory.with_suffix(".json"))
        if env.control_mode != "pd_joint_pos":
            raise EvaluationError(
                "can't be played here", where=trajectory, expected="pd_joint_pos", found=env.control_mode
            )
        if any(map(was_taken_over, data["episodes"])):
            what, fix = "episodes that begin where another policy was", "Use robocas replay, which begins there too."
            raise EvaluationError(what, where=trajectory, expected="episodes that begin with a reset", fix=fix)
        self._trajectory = trajectory
        self._episodes = {
            read_reset(one, f"{trajectory}, traj_{one['episode_id']}")[0]: one["episode_id"] for one in data["episodes"]
        }
        self.spec = PolicySpec(
            convention="joint_positions",
            rate_hz=env.kwargs.get("sim_config", {}).get("control_freq", 20),
            language="none",
        )
        self._followers = Followers()

    def describe(self) -> dict[str, Any]:
        """What a result says of it."""
        return {"trajectory": self._trajectory.name, "episodes": len(self._episodes)}

    def reset(self, starts: list[EpisodeSpec]) -> None:
        """Look up the episodes by their seeds."""
        for start in starts:
            self._followers.begin(start.env, JointTrack(self._actions(start.seed)))

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """(E, 8) joint targets."""
        return self._followers.act(observations)

    def _actions(self, seed: int) -> NDArray[np.floating]:
        """(S, 8) of a recorded episode; none where there is none."""
        if seed not in self._episodes:
            return np.zeros((0, 8))
        with open_trajectory(self._trajectory) as file:
            actions = read_actions(open_episode(file, self._episodes[seed]))
        if actions.shape[1] != 8:
            where = f"{self._trajectory}, traj_{self._episodes[seed]}"
            raise EvaluationError(
                "can't be played here", where=where, expected="8 numbers an action", found=actions.shape[1]
            )
        return actions
