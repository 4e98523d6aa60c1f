"""Execute planned motions in an environment and store the actions since the reset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from robocas_ms3.planning.action_noise import ActionNoise
from robocas_ms3.planning.decisions import CpuSeconds, MoveExperience
from robocas_ms3.planning.protocol import Array, Trajectory
from robocas_ms3.tasks.base import RoboCASEnv

OPEN, CLOSED = 1.0, -1.0


@dataclass
class Segment:
    """Segment of the demonstration with one sub-goal.

    Attributes:
        goal_type: type of the sub-goal, e.g. ``transfer object``.
        goal_description: sub-goal as a sentence.
        first: index of the first action of the segment.
    """

    goal_type: str
    goal_description: str
    first: int


@dataclass
class MotionExecutor:
    """Executor that sends planned motions to one environment as joint targets.

    Attributes:
        env: environment with ``num_envs`` = 1 and control mode ``pd_joint_pos`` or ``pd_joint_pos_base``, possibly
            wrapped by a recorder.
        seed: seed of the episode.
        actions: intended actions since the reset, (8,) each: 7 arm joints in rad and the gripper command; with
            ``pd_joint_pos_base`` (11,): also x in m, y in m and yaw in rad of the base. Without ``noise`` they are
            the executed actions.
        segments: segments since the reset, one per sub-goal.
        info: info of the last step or reset.
        gripper: last gripper command, 1 open or -1 closed.
        base: (3,) last command of the base joints: x m, y m, yaw rad.
        seconds: CPU seconds of the episode.
        facts: counters that the policy sets and the recording stores, e.g. ``pushes``.
        experience: results of the moves in all attempts at the seed; `reset` keeps them.
        check_open_loop: function that replays the actions since the reset open loop; it raises UnrecoverableError if
            the target deviates from the recording.
        noise: noise that is added to the joint targets; None: no noise.
        deviations: deviations of the arm joints (7,) that the noise has caused at the end of each action, rad.
    """

    env: gym.Env
    seed: int
    actions: list[np.ndarray] = field(default_factory=list)
    segments: list[Segment] = field(default_factory=list)
    info: dict[str, Any] = field(default_factory=dict)
    gripper: float = OPEN
    base: Array = field(default_factory=lambda: np.zeros(3))
    seconds: CpuSeconds = field(default_factory=CpuSeconds)
    facts: dict[str, Any] = field(default_factory=dict)
    experience: MoveExperience = field(default_factory=MoveExperience)
    check_open_loop: Callable[[], None] = lambda: None
    noise: ActionNoise | None = None
    deviations: list[Array] = field(default_factory=list)

    @property
    def base_env(self) -> RoboCASEnv:
        """Environment without wrappers."""
        env = self.env.unwrapped
        assert isinstance(env, RoboCASEnv)
        return env

    @property
    def dt(self) -> float:
        """Duration of a control step, s."""
        return self.base_env.control_timestep

    def reset(self) -> None:
        with self.seconds.measure("reset"):
            _, self.info = self.env.reset(seed=self.seed)
        self.actions, self.segments, self.gripper, self.base = [], [], OPEN, np.zeros(3)
        self.facts, self.deviations = {}, []
        if self.noise is not None:
            self.noise.reset()

    def follow(self, trajectory: Trajectory, *, until: str | None = None) -> bool:
        """Send the rows of a trajectory to the arm, one per control step, with the last gripper command.

        Args:
            trajectory: motion of the arm.
            until: key of ``info``, e.g. ``success``; the motion stops as soon as this flag is set.

        Returns:
            Whether the flag is set after the last step; True without ``until``.
        """
        for qpos in trajectory.qpos:
            if until and self.is_flag_set(until):
                return True
            self._step(self._action(qpos))
        return until is None or self.is_flag_set(until)

    def move_gripper(self, command: float, arm_qpos: Array, *, seconds: float) -> None:
        """Command the gripper (``OPEN`` or ``CLOSED``) for some seconds; the arm stays at ``arm_qpos`` (7,)."""
        self.gripper = command
        for _ in range(max(1, round(seconds / self.dt))):
            self._step(self._action(arm_qpos))

    @property
    def drives_base(self) -> bool:
        """Whether actions contain targets of the base joints."""
        return self.base_env.control_mode.endswith("_base")

    def drive(self, waypoints: Array, arm_qpos: Array) -> None:
        """Send targets of the base joints, one per control step; the arm stays at ``arm_qpos`` (7,).

        ``waypoints`` (T, 3) contains x m, y m, yaw rad.
        """
        for base in waypoints:
            self.base = base
            self._step(self._action(arm_qpos))

    def _action(self, qpos: Array) -> np.ndarray:
        base = self.base if self.drives_base else ()
        return np.concatenate([qpos, [self.gripper], base]).astype(np.float32)

    def start_subgoal(self, goal_type: str, goal_description: str) -> None:
        """Start a segment with a sub-goal at the next action.

        There is no effect if the current segment has the same sub-goal.
        """
        if self.segments and self.segments[-1].first == len(self.actions):
            self.segments.pop()
        if not self.segments or (self.segments[-1].goal_type, self.segments[-1].goal_description) != (
            goal_type,
            goal_description,
        ):
            self.segments.append(Segment(goal_type, goal_description, len(self.actions)))

    def is_flag_set(self, name: str) -> bool:
        """Return a boolean value of ``info`` of the last step by its key, e.g. ``success``."""
        return bool(self.info[name][0])

    def _step(self, action: np.ndarray) -> None:
        executed = action
        if self.noise is not None:
            executed = action.copy()
            executed[:7], deviation = self.noise.disturb(self.seed, len(self.actions), action[:7])
            self.deviations.append(deviation)
        with self.seconds.measure("simulation"):
            *_, self.info = self.env.step(executed)
        self.actions.append(action)
