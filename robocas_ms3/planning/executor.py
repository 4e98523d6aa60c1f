"""Run planned motions in an environment and store the actions since the reset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from robocas_ms3.planning.decisions import CpuSeconds
from robocas_ms3.planning.protocol import Array, Trajectory
from robocas_ms3.tasks.base import RoboCASEnv

OPEN, CLOSED = 1.0, -1.0


@dataclass
class Segment:
    """A sub-goal of the demonstration, valid from action index ``first`` on."""

    goal_type: str
    goal_description: str
    first: int


@dataclass
class MotionExecutor:
    """MotionExecutor of motions in one environment with control mode ``pd_joint_pos`` or ``pd_joint_pos_base``.

    Attributes:
        env: environment with ``num_envs`` = 1, possibly wrapped by a recorder.
        actions: actions since the reset, (8,) each, or (11,) with base joints.
        segments: sub-goals since the reset.
        info: info of the last step or reset.
        gripper: last gripper command.
        base: (3,) last command of the base joints: x m, y m, yaw rad.
        facts: counters of the policy that are recorded, e.g. ``pushes``.
        check_open_loop: replays the actions so far open loop; raises UnrecoverableError if the result differs.
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
    check_open_loop: Callable[[], None] = lambda: None

    @property
    def base_env(self) -> RoboCASEnv:
        env = self.env.unwrapped
        assert isinstance(env, RoboCASEnv)
        return env

    @property
    def dt(self) -> float:
        return self.base_env.control_timestep

    def reset(self) -> None:
        with self.seconds.measure("reset"):
            _, self.info = self.env.reset(seed=self.seed)
        self.actions, self.segments, self.gripper, self.base = [], [], OPEN, np.zeros(3)
        self.facts = {}

    def follow(self, trajectory: Trajectory, *, until: str | None = None) -> bool:
        """Send the rows of a trajectory to the arm with the last gripper command.

        Stop as soon as the flag ``until`` of ``info`` is set; return whether it is set, or True without ``until``.
        """
        for qpos in trajectory.qpos:
            if until and self.flag(until):
                return True
            self._step(self._action(qpos))
        return until is None or self.flag(until)

    def move_gripper(self, command: float, hold: Array, *, seconds: float) -> None:
        """Command the gripper (``OPEN`` or ``CLOSED``) for some seconds; the arm holds a configuration (7,)."""
        self.gripper = command
        for _ in range(max(1, round(seconds / self.dt))):
            self._step(self._action(hold))

    @property
    def drives_base(self) -> bool:
        """Whether actions include the base joints."""
        return self.base_env.control_mode.endswith("_base")

    def drive(self, waypoints: Array, hold: Array) -> None:
        """Send base joint targets (T, 3), one per control step, while the arm holds a configuration (7,).

        Targets are x m, y m, yaw rad.
        """
        for base in waypoints:
            self.base = base
            self._step(self._action(hold))

    def _action(self, qpos: Array) -> np.ndarray:
        base = self.base if self.drives_base else ()
        return np.concatenate([qpos, [self.gripper], base]).astype(np.float32)

    def start_subgoal(self, goal_type: str, goal_description: str) -> None:
        """Start a sub-goal with the next action; starting the current sub-goal again has no effect."""
        if self.segments and self.segments[-1].first == len(self.actions):
            self.segments.pop()
        if not self.segments or (self.segments[-1].goal_type, self.segments[-1].goal_description) != (
            goal_type,
            goal_description,
        ):
            self.segments.append(Segment(goal_type, goal_description, len(self.actions)))

    def flag(self, name: str) -> bool:
        """Return a flag of the last ``info``, e.g. ``success``."""
        return bool(self.info[name][0])

    def _step(self, action: np.ndarray) -> None:
        with self.seconds.measure("simulation"):
            *_, self.info = self.env.step(action)
        self.actions.append(action)
