"""Policies whose actions are known at the start of an episode, as joint targets or as TCP poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.demos.recordings.environment import read_recorded_env
from robocas_ms3.demos.recordings.motion import Motion
from robocas_ms3.demos.recordings.trajectory_hdf5 import open_episode, open_trajectory, read_actions
from robocas_ms3.demos.recordings.trajectory_json import is_intervention, read_json, read_reset
from robocas_ms3.evaluation.policy import EpisodeSpec, Observations, PolicySpec
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.registry import RobotSpec

Array = NDArray[np.floating]


@dataclass
class JointTrack:
    """Sequence of joint targets for one episode.

    Attributes:
        actions: (S, 8) seven joint targets in rad and the gripper, -1 closed to 1 open. After the last action, the last
            action is repeated. With S = 0 the arm keeps its present joint angles and the gripper is open.
        step: index of the next action.
    """

    actions: Array
    step: int = 0

    def next_action(self, observations: Observations, row: int) -> Array:
        """Return the next action (8,), in the convention ``joint_positions``; ``row``: row of the env."""
        if not len(self.actions):
            self.actions = np.append(observations.qpos[row, RobotDescription.arm_slice], 1.0)[None]
        action = self.actions[min(self.step, len(self.actions) - 1)]
        self.step += 1
        return action


@dataclass
class PoseTrack:
    """Sequence of TCP poses for one episode, one per policy step; an action moves from the present to the next pose.

    Attributes:
        poses: (S, 4, 4) in the frame of the arm's base. After the last pose, the last pose is held.
        open: (S,) bool gripper commands, True: open.
        step: index of the next pose.
    """

    poses: Array
    open: NDArray[np.bool_]
    step: int = 0

    @classmethod
    def from_recording(
        cls, robot: RobotSpec, robot_states: Array, gripper_commands: Array, samples: NDArray[np.int64]
    ) -> PoseTrack:
        """Return the TCP poses of a recording in some of its states.

        Args:
            robot: specification of the recorded robot.
            robot_states: (S + 1, 37) ManiSkill states of the robot after the reset and after each of S control steps.
            gripper_commands: (S,) gripper commands, -1 closed to 1 open.
            samples: (T + 1,) indices of states in ascending order; the first is the present state.
        """
        motion = Motion.from_states(robot, robot_states, gripper_commands, samples)
        return cls(motion.tcp_in_base[1:], motion.gripper_open[1:])

    def next_action(self, observations: Observations, row: int, shift: Array | None = None) -> Array:
        """Return the next action (7,), in the convention ``robocas``.

        Args:
            observations: observations of several envs.
            row: row of the env.
            shift: (3,) translation of the next pose, in m in the frame of the arm's base; None: no translation.
        """
        index = min(self.step, len(self.poses) - 1)
        self.step += 1
        tcp = observations.tcp_in_base[row].astype(np.float64)
        turn = Rotation.from_quat(tcp[[4, 5, 6, 3]]).inv()
        goal = self.poses[index, :3, 3] + (0.0 if shift is None else shift)
        motion = turn.apply(goal - tcp[:3])
        angles = (turn * Rotation.from_matrix(self.poses[index, :3, :3])).as_euler("xyz")
        return np.array([*motion, *angles, float(self.open[index])])


class ReplayPolicy:
    """Policy that replays recorded joint targets, at the control rate of the recording.

    An episode replays the recording with the same seed. If there is none, the arm does not move.

    Args:
        trajectory: HDF5 file with actions in the control mode ``pd_joint_pos``, next to its JSON file.
    """

    def __init__(self, trajectory: Path) -> None:
        self._tracks: dict[int, JointTrack] = {}  # by env
        self._trajectory = trajectory = trajectory.absolute()
        data = read_json(trajectory)
        env = read_recorded_env(data["env_info"], trajectory.with_suffix(".json"))
        if env.control_mode != "pd_joint_pos":
            what, found = "cannot replay a recording with this control mode", env.control_mode
            raise EvaluationError(what, where=trajectory, expected="pd_joint_pos", found=found)
        if any(map(is_intervention, data["episodes"])):
            what, fix = (
                "cannot replay expert interventions, which start in a state of another policy",
                "Replay this file with `robocas replay`.",
            )
            raise EvaluationError(what, where=trajectory, expected="episodes that start with a reset", fix=fix)
        self._episodes = {
            read_reset(one, f"{trajectory}, traj_{one['episode_id']}")[0]: one["episode_id"] for one in data["episodes"]
        }
        rate = env.kwargs.get("sim_config", {}).get("control_freq", 20)
        # The recorded targets were planned from privileged state.
        self.spec = PolicySpec(convention="joint_positions", rate_hz=rate, language="none", track="privileged")

    def describe(self) -> dict[str, Any]:
        return {"trajectory": self._trajectory.name, "episodes": len(self._episodes)}

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        self._tracks |= {episode.env: self.make_track(episode) for episode in episodes}

    def act(self, observations: Observations) -> Array:
        """Return the next action (8,) of each env, (E, 8)."""
        envs = observations.envs.tolist()
        return np.stack([self._tracks[env].next_action(observations, row) for row, env in enumerate(envs)])

    def make_track(self, episode: EpisodeSpec) -> JointTrack:
        """Return the recorded targets for an episode."""
        if episode.seed not in self._episodes:
            return JointTrack(np.zeros((0, 8)))
        number = self._episodes[episode.seed]
        with open_trajectory(self._trajectory) as file:
            actions = read_actions(open_episode(file, number))
        if (found := actions.shape[1]) != 8:
            where, expected = f"{self._trajectory}, traj_{number}", "8 numbers per action, without the base"
            raise EvaluationError(
                "cannot replay actions of this size", where=where, expected=expected, found=f"{found} numbers"
            )
        return JointTrack(actions)
