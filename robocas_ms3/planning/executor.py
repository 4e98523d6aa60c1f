"""Run planned motions in an environment and keep what was done since the reset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from robocas_ms3.planning.decisions import Seconds
from robocas_ms3.planning.protocol import Array, Trajectory
from robocas_ms3.tasks.base import RoboCASEnv

OPEN, CLOSED = 1.0, -1.0


@dataclass
class Segment:
    """A part of the demonstration with one sub-goal, from the action of index ``first`` on."""

    goal_type: str
    goal_description: str
    first: int


@dataclass
class Executor:
    """Steps one environment (``pd_joint_pos`` or ``pd_joint_pos_base``, one env); keeps all actions since the reset.

    Attributes:
        env: may be wrapped by a recorder.
        actions: every action since the reset, (8,) each, or (11,) where the base is driven.
        segments: the sub-goals so far.
        info: of the last step or reset.
        gripper: last command of the gripper.
        base: (3,) last command of the base joints: x m, y m, yaw rad.
        facts: counters of the policy for the record, e.g. ``pushes``.
        check_open_loop: replays the actions so far open loop; raises ``UnrecoverableError`` where the outcome differs.
    """

    env: gym.Env
    seed: int
    actions: list[np.ndarray] = field(default_factory=list)
    segments: list[Segment] = field(default_factory=list)
    info: dict[str, Any] = field(default_factory=dict)
    gripper: float = OPEN
    base: Array = field(default_factory=lambda: np.zeros(3))
    seconds: Seconds = field(default_factory=Seconds)
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
        """Send a trajectory's rows to the arm, holding the gripper's command.

        It stops as soon as the flag ``until`` of ``info`` is set; returns whether it is, or True without one.
        """
        for qpos in trajectory.qpos:
            if until and self.flag(until):
                return True
            self._step(self._action(qpos))
        return until is None or self.flag(until)

    def move_gripper(self, command: float, hold: Array, *, seconds: float) -> None:
        """Command the gripper (``OPEN`` or ``CLOSED``) for some seconds, with the arm held at (7,) rad."""
        self.gripper = command
        for _ in range(max(1, round(seconds / self.dt))):
            self._step(self._action(hold))

    @property
    def drives_base(self) -> bool:
        return self.base_env.control_mode.endswith("_base")

    def drive(self, waypoints: Array, hold: Array) -> None:
        """Send base joint targets (T, 3), x m, y m, yaw rad, one per control step, with the arm held at (7,) rad."""
        for base in waypoints:
            self.base = base
            self._step(self._action(hold))

    def _action(self, qpos: Array) -> np.ndarray:
        base = self.base if self.drives_base else ()
        return np.concatenate([qpos, [self.gripper], base]).astype(np.float32)

    def start_subgoal(self, goal_type: str, goal_description: str) -> None:
        """Begin a sub-goal with the next action; a label that repeats the last one changes nothing."""
        if self.segments and self.segments[-1].first == len(self.actions):
            self.segments.pop()
        if not self.segments or (self.segments[-1].goal_type, self.segments[-1].goal_description) != (
            goal_type,
            goal_description,
        ):
            self.segments.append(Segment(goal_type, goal_description, len(self.actions)))

    def flag(self, name: str) -> bool:
        return bool(self.info[name][0])

    def _step(self, action: np.ndarray) -> None:
        with self.seconds.measure("simulation"):
            *_, self.info = self.env.step(action)
        self.actions.append(action)
