"""Compare the present scene with the scene that a plan expects at that time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.poses import inverse, transform_points
from robocas_ms3.demos.recordings.motion import split_robot_states
from robocas_ms3.robots.description_file import tcp_and_arm_base_poses
from robocas_ms3.robots.registry import RobotSpec

Array = NDArray[np.float64]
States = Mapping[str, Mapping[str, NDArray[np.floating]]]

MAX_OFFSET = 0.02  # m between a body that the plan will move and its expected position in the world
MAX_BYSTANDER_OFFSET = 0.06  # m, the same for a body that the plan will not move; it can only be in the way
MOVED_LATER = 0.10  # m by which a body moves in the rest of the plan if the plan moves it on purpose
MAX_HELD_OFFSET = 0.04  # m between a body and its expected position relative to the TCP: grasps vary
MAX_JOINT_OFFSET = 0.05  # m or rad between a furniture joint and its expected position
MAX_TCP_OFFSET = 0.15  # m between the TCP and its expected position; more than the lag of the arm
FADE, LIFT = 20, 10  # states of a plan: to shift a grasp to a displaced body or back to the plan; from grasp to lift
CARRIED = 0.05  # m by which a held body moves at least
MOTION = 0.01  # m or rad by which a body or joint moves in the plan to count as moving
MOTION_SAMPLES = 10  # states before and after the present one in which it moves
HELD_WIDTH = 0.004  # m, least width of a closed gripper that holds a body
_BODY, _LINEAR = 13, slice(7, 10)  # numbers per body, linear velocity


@dataclass(frozen=True)
class SceneState:
    """Positions in T states of a scene.

    Attributes:
        tcp: (T, 4, 4) poses of the TCP in the world frame.
        bodies: (T, B, 3) positions of the movable bodies in the world frame, m.
        joints: (T, J) positions of the joints of the furniture, m or rad.
        width: (T,) widths of the gripper, m.
    """

    tcp: Array
    bodies: Array
    joints: Array
    width: Array

    @classmethod
    def from_states(cls, robot: RobotSpec, states: States) -> SceneState:
        """Read T states of ``set_state_dict``, ``{"actors": {name: (T, 13)}, "articulations": {name: (T, D)}}``."""
        uid, furniture = robot.description.uid, {**states["articulations"]}
        root, qpos, _ = split_robot_states(furniture.pop(uid))
        count = len(qpos)
        joints = [
            of[:, _BODY : _BODY + (of.shape[1] - _BODY) // 2].astype(np.float64) for _, of in sorted(furniture.items())
        ]
        return cls(
            tcp_and_arm_base_poses(robot, root, qpos)[0],
            np.stack([states["actors"][name][:, :3] for name in sorted(states["actors"])], axis=1).astype(np.float64),
            np.concatenate([np.zeros((count, 0)), *joints], axis=1),
            qpos[:, robot.description.finger_slice].sum(axis=1),
        )


@dataclass(frozen=True)
class PlannedGrasp:
    """Grasp of a body in a plan.

    Attributes:
        body: index of the body.
        closes: index of the last state before the gripper closes.
        holds: index of the first state in which the gripper holds the body.
    """

    body: int
    closes: int
    holds: int

    def shift_weight(self, index: int) -> float:
        """Return the fraction of the body's displacement by which the TCP pose of a state is shifted, 0 to 1.

        It grows in the `FADE` states before the gripper closes, and falls in `FADE` states after the lift.
        """
        rise, fall = (index - self.closes) / FADE + 1, (self.holds + LIFT + FADE - index) / FADE
        return float(np.clip(min(rise, fall), 0.0, 1.0))


@dataclass(frozen=True)
class PlannedScene:
    """Scene that a plan expects after the reset and after each of S control steps.

    Attributes:
        states: the S + 1 expected states.
        closed: (S + 1,) bool, whether the last gripper command before each state closes the gripper.
    """

    states: SceneState
    closed: NDArray[np.bool_]

    @property
    def holding(self) -> NDArray[np.bool_]:
        """Whether the gripper holds a body in each state, (S + 1,) bool."""
        return self.closed & (self.states.width > HELD_WIDTH)

    def list_grasps(self) -> list[PlannedGrasp]:
        """Return the grasps of the plan in their order, without one that started before the plan."""
        edges = np.flatnonzero(np.diff(np.concatenate([[False], self.holding, [False]]).astype(int)))
        in_tcp, found = _positions_in_tcp(self.states), []
        for first, after in edges.reshape(-1, 2).tolist():
            moved = np.linalg.norm(self.states.bodies[after - 1] - self.states.bodies[first], axis=-1)
            slipped = np.linalg.norm(in_tcp[after - 1] - in_tcp[first], axis=-1)
            held = np.flatnonzero((moved > CARRIED) & (slipped < MAX_HELD_OFFSET))
            opened = np.flatnonzero(~self.closed[:first])
            if len(held) and len(opened):  # else the body was held at the start of the plan
                found.append(PlannedGrasp(int(held[np.argmin(slipped[held])]), int(opened[-1]), first))
        return found

    def find_deviations(self, now: SceneState, index: int, window: int) -> list[int]:
        """Return the indices of the bodies that are not where the plan expects them, B + j for furniture joint j.

        While the gripper holds a body, only the bodies that move in the plan at that time are compared: if the held
        body is where the plan expects it, in the world or relative to the TCP, the rest of the scene does not matter.
        Otherwise only the other bodies are compared, so a pushed body is compared when it is at rest. Nothing is
        compared after the last release.

        Args:
            now: the present state, T = 1.
            index: index of the expected state.
            window: number of states before and after it whose positions also count as expected.
        """
        if self.holding.any() and not self.holding[index:].any():
            return []
        near = slice(max(0, index - window), index + window + 1)
        planned, moves = self.states, self._find_moving(index)
        later = np.linalg.norm(planned.bodies[index:] - planned.bodies[index], axis=-1).max(axis=0) > MOVED_LATER
        tolerance = np.where(later | moves[: len(later)], MAX_OFFSET, MAX_BYSTANDER_OFFSET)
        away = np.linalg.norm(now.bodies[0] - planned.bodies[near], axis=-1).min(axis=0) > tolerance
        joints = np.abs(now.joints[0] - planned.joints[near]).min(axis=0) > MAX_JOINT_OFFSET
        if self.holding[index]:
            offsets = _positions_in_tcp(now) - _positions_in_tcp(planned, near)
            away &= np.linalg.norm(offsets, axis=-1).min(axis=0) > MAX_HELD_OFFSET
            return np.flatnonzero(np.append(away, joints) & moves).tolist()
        return np.flatnonzero(np.append(away, joints) & ~moves).tolist()

    def is_tcp_away(self, now: SceneState, index: int, window: int) -> bool:
        """Return whether the TCP is farther from its planned positions around ``index`` than the arm can lag."""
        near = slice(max(0, index - window), index + window + 1)
        return bool(np.linalg.norm(now.tcp[0, :3, 3] - self.states.tcp[near, :3, 3], axis=-1).min() > MAX_TCP_OFFSET)

    def _find_moving(self, index: int) -> NDArray[np.bool_]:
        near, planned = slice(max(0, index - MOTION_SAMPLES), index + MOTION_SAMPLES + 1), self.states
        bodies = np.linalg.norm(planned.bodies[near] - planned.bodies[index], axis=-1).max(axis=0)
        joints = np.abs(planned.joints[near] - planned.joints[index]).max(axis=0)
        return np.append(bodies, joints) > MOTION


def _positions_in_tcp(states: SceneState, near: slice = slice(None)) -> Array:
    """Return the positions (T, B, 3) of the bodies in the frame of the TCP."""
    return transform_points(inverse(states.tcp[near]), states.bodies[near]).astype(np.float64)


def measure_speeds(values: States) -> Array:
    """Return the speed of each movable body in a state, (B,) m/s, in the order of `SceneState.bodies`."""
    speeds = [float(np.linalg.norm(values["actors"][name][0, _LINEAR])) for name in sorted(values["actors"])]
    return np.array(speeds)
