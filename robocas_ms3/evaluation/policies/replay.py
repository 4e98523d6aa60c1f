"""Recorded episodes, repeated in the scenes of the same seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.demos.recordings.entries import read_json, read_reset, was_taken_over
from robocas_ms3.demos.recordings.environment import read_env
from robocas_ms3.demos.recordings.stored import open_episode, open_trajectory, read_actions
from robocas_ms3.evaluation.policies.tracks import JointTrack, TrackPolicy
from robocas_ms3.evaluation.policy import EpisodeSpec, PolicySpec


class ReplayPolicy(TrackPolicy):
    """Repeat the actions of a trajectory file, at its rate; do not move in an episode whose seed it lacks.

    Args:
        trajectory: HDF5 file of joint targets (``pd_joint_pos``), with its JSON file next to it.

    Raises:
        EvaluationError: its actions are no joint targets.
        DatasetError: it can't be read.
    """

    def __init__(self, trajectory: Path) -> None:
        super().__init__()
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

    def describe(self) -> dict[str, Any]:
        """Return the entries of a result."""
        return {"trajectory": self._trajectory.name, "episodes": len(self._episodes)}

    def track(self, start: EpisodeSpec) -> JointTrack:
        """Return the recorded actions of the episode's seed."""
        if start.seed not in self._episodes:
            return JointTrack(np.zeros((0, 8)))
        number = self._episodes[start.seed]
        with open_trajectory(self._trajectory) as file:
            actions = read_actions(open_episode(file, number))
        if actions.shape[1] != 8:
            where = f"{self._trajectory}, traj_{number}"
            raise EvaluationError(
                "can't be played here", where=where, expected="8 numbers an action", found=actions.shape[1]
            )
        return JointTrack(actions)
