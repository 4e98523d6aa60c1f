"""Paths of the arm: inverse kinematics, straight lines and joint motions, without a planner."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.baselines.keyframe.handles import Handle
from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import Array, from_rotation, inverse
from robocas_ms3.planning.kinematics import ArmChain, InverseKinematics, joint_distance, solve_straight_line
from robocas_ms3.planning.pull_path import count_reached_poses, rotate_about_bar, track_handle
from robocas_ms3.robots.registry import RobotSpec
from robocas_ms3.scenes.grasp_checks import HALF_TURN, PREGRASP_DISTANCE

LIFT = 0.12
"""m that an object is lifted after a grasp."""
_JOINT_STEP = 0.03  # rad between the configurations of a joint motion
_MAX_TRANSLATION, _MAX_ROTATION = 0.095, 0.45  # m along an axis and rad per control step of 0.2 s; 5 % below the limits
_MAX_JOINT_STEP = 0.4  # rad per control step
_MAX_HALVINGS = 3  # of the limits, after motions that the arm did not execute
_LEAST_MOTION = 0.01  # m, commanded motion from which on the executed motion is checked
_MAX_APPROACHES = 48  # grasps for which approaches are planned
_PULL_STEP, _PULL_STANDOFF, _RETREATS = 0.015, 0.08, (0.15, 0.1, 0.06)  # m
_PULL_TURNS = np.deg2rad((0, -20, 20, -40, 40))  # about the bar
_LOWER = (0.0, 0.05, 0.1)  # m below the height of a rise, of its alternative ends
_NEARER = (1.0, 0.93, 0.86, 0.78)  # fractions of the distance from the base


@dataclass(frozen=True)
class Approach:
    """Motion to a grasp.

    Attributes:
        grasp: (4, 4) TCP pose of the grasp in the arm's base frame.
        start: (7,) configuration at the pre-grasp, rad.
        path: (n, 7) straight path from the pre-grasp to the grasp, rad.
        exit_path: (n, 7) path with the object out of a compartment; None: upwards.
    """

    grasp: Array
    start: Array
    path: Array
    exit_path: Array | None = None


@dataclass(frozen=True)
class Pull:
    """Motion that opens a door or drawer.

    Attributes:
        start: (7,) configuration at the pre-grasp of the handle, rad.
        path: (n, 7) straight path from the pre-grasp to the grasp, rad.
        pull: (m, 7) path of the closed gripper, rad.
    """

    start: Array
    path: Array
    pull: Array


class ArmPaths:
    """Paths of an arm, computed from its kinematics.

    Args:
        robot: specification of the robot.

    Raises:
        RobotDescriptionError, RobocasError: the robot has no inverse kinematics for this arm.
    """

    def __init__(self, robot: RobotSpec) -> None:
        self.chain = ArmChain(robot.files().arm_urdf, robot.description)
        self.kinematics = InverseKinematics(self.chain)

    def straight(self, qpos: Array, tcp_in_base: Array, *, sequential: bool = True) -> Array | None:
        """Return a straight path (n, 7) from a configuration (7,) to a TCP pose (4, 4), or None.

        sequential: see `solve_straight_line`.
        """
        try:
            return solve_straight_line(self.chain, qpos, tcp_in_base, stage="keyframe", sequential=sequential)
        except PlanningError:
            return None

    def joint(self, qpos: Array, goal: Array) -> Array:
        """Return a path (n, 7) from a configuration to another one, straight in joint space."""
        count = max(2, int(np.ceil(np.abs(goal - qpos).max() / _JOINT_STEP)))
        return np.asarray(np.linspace(qpos, goal, count + 1)[1:], np.float64)

    def rise(self, qpos: Array, tcp_in_base: Array, height: float) -> Array | None:
        """Return a path (n, 7) that raises the TCP from its pose (4, 4) to a height in m, or None.

        Where the pose above is out of reach, the TCP also moves towards the base, or stays up to 10 cm lower.
        """
        for lower in _LOWER:
            for nearer in _NEARER:
                goal = tcp_in_base.copy()
                goal[2, 3] = max(height - lower, tcp_in_base[2, 3] + 0.02)
                goal[:2, 3] *= nearer
                path = self.straight(qpos, goal)
                if path is not None:
                    return path
        return None

    def reach(self, tcp_in_base: Array, qpos: Array) -> tuple[NDArray[np.bool_], Array]:
        """Return which TCP poses (N, 4, 4) are in reach, (N,) bool, and the nearest configurations (N, 7)."""
        return self.kinematics.nearest_solutions(tcp_in_base, qpos)

    def is_grasp_in_reach(self, grasps: Array, qpos: Array) -> NDArray[np.bool_]:
        """Return (G,) bool, whether grasps (G, 4, 4) and their pre-grasps are in reach, also after half a turn.

        qpos: (7,) present configuration.
        """
        poses = np.stack([grasps, grasps @ HALF_TURN])
        before = poses.copy()
        before[..., :3, 3] -= PREGRASP_DISTANCE * poses[..., :3, 2]
        reachable, _ = self.reach(np.concatenate([poses, before]).reshape(-1, 4, 4), qpos)
        of_grasp, of_pregrasp = reachable.reshape(2, 2, len(grasps))
        return np.asarray((of_grasp & of_pregrasp).any(axis=0))

    def nearest(self, tcp_in_base: Array, costs: Array, qpos: Array, weight: float) -> list[tuple[int, Array]]:
        """Return the reachable poses (N, 4, 4) as pairs (index, configuration), the cheapest first.

        costs: (N,) cost of each pose; ``weight`` times the joint distance from ``qpos`` (7,) is added.
        """
        reachable, found = self.reach(tcp_in_base, qpos)
        total = costs + weight * joint_distance(found, qpos)
        total[~reachable] = np.inf
        order = np.argsort(total, kind="stable")[: int(reachable.sum())]
        return [(int(index), found[index]) for index in order]

    def plan_pulls(self, handle: Handle, qpos: Array) -> Iterator[Pull]:
        """Yield pulls of a handle, the longest first. The gripper may turn about the bar.

        qpos: (7,) present configuration.
        """
        count = max(2, int(np.ceil(np.linalg.norm(handle.motion) / _PULL_STEP)) + 1)
        held = np.tile(handle.grasp, (count, 1, 1))
        held[:, :3, 3] += np.linspace(0, 1, count)[:, None] * handle.motion
        turned = held @ HALF_TURN
        goals = [one for one in (held, turned) for _ in _PULL_TURNS]
        starts = [rotate_about_bar(one[0], turn) for one in (held, turned) for turn in _PULL_TURNS]
        reachable, found = self.reach(np.array(starts), qpos)
        if not reachable.any():
            return
        paths = track_handle(self.chain, found[reachable], np.stack(goals, axis=1)[:, reachable])
        lengths, distance = count_reached_poses(paths), joint_distance(found[reachable], qpos)
        for index in np.lexsort((distance, -lengths)).tolist():
            path = paths[: lengths[index], index]
            if len(path) < 2:
                continue
            back = self._back_off(path[0], _PULL_STANDOFF)
            if back is not None and self.retreat(path[-1]) is not None:
                yield Pull(back[-1], np.concatenate([back[-2::-1], path[:1]]), path)

    def retreat(self, qpos: Array) -> Array | None:
        """Return the longest straight path (n, 7) away from a handle at a configuration (7,), or None."""
        paths = (self._back_off(qpos, distance) for distance in _RETREATS)
        return next((path for path in paths if path is not None), None)

    def _back_off(self, qpos: Array, distance: float) -> Array | None:
        """Return a straight path (n, 7) against the approach direction, or None."""
        goal = self.chain.tcp(qpos[None])[0]
        goal[:3, 3] -= distance * goal[:3, 2]
        return self.straight(qpos, goal)

    def plan_approach(self, grasps: Array, scores: Array, qpos: Array) -> Approach | None:
        """Return the approach of the reachable grasp with the greatest score, or None.

        grasps: (G, 4, 4) TCP poses in the arm's base frame. scores: (G,). qpos: (7,) present configuration.
        """
        order = np.argsort(-scores, kind="stable")[:_MAX_APPROACHES]
        turned = grasps[order] @ HALF_TURN
        both = np.stack([grasps[order], turned], axis=1).reshape(-1, 4, 4)
        starts = both.copy()
        starts[:, :3, 3] -= PREGRASP_DISTANCE * both[:, :3, 2]
        reachable, found = self.reach(starts, qpos)
        reachable &= self.reach(both, qpos)[0]
        distance = np.where(reachable, joint_distance(found, qpos), np.inf).reshape(-1, 2)
        for number in range(len(order)):
            for turn in np.argsort(distance[number]).tolist():
                row = 2 * number + turn
                if not reachable[row]:
                    continue
                path = self.straight(found[row], both[row])
                if path is None or self.rise(path[-1], both[row], float(both[row][2, 3]) + LIFT) is None:
                    continue
                return Approach(both[row], found[row], path)
        return None


class PathFollower:
    """Follows a path with motions of the TCP that are relative to its present pose.

    The controller of the arm may find no joint positions for a distant pose. Then the arm stays, and the follower
    repeats the motion with half the limits. It halves the limits at most three times. If the arm is far from the path,
    the follower first moves straight to it.

    Args:
        chain: kinematics of the arm.
        path: (n, 7) configurations.
        control_steps: control steps of 0.2 s per policy step.
        speed: fraction of the greatest motions.

    Attributes:
        index: index of the configuration to which the last motion led. If the arm is far from the path, it still moves
            to this configuration.
    """

    def __init__(self, chain: ArmChain, path: Array, control_steps: int, speed: float = 1.0) -> None:
        self._path, self._poses, self.index = path, chain.tcp(path), 0
        self._limits = np.array([_MAX_TRANSLATION, _MAX_ROTATION, _MAX_JOINT_STEP]) * control_steps * speed
        self._halvings, self._before = 0, 0
        self._start: Array | None = None  # TCP pose before the last motion
        self._goal = self._poses[0]  # TCP pose after it

    @property
    def goal(self) -> Array:
        """TCP pose (4, 4) at the end of the path."""
        return self._poses[-1]

    @property
    def is_last(self) -> bool:
        """Whether the last motion led to the end of the path."""
        return self.index == len(self._path) - 1

    def next_pose(self, tcp_in_base: Array) -> Array:
        """Return the farthest TCP pose (4, 4) of the path, or on the way to it, that the next policy step can reach."""
        if self._halvings < _MAX_HALVINGS and self._start is not None and self._has_stayed(self._start, tcp_in_base):
            self._halvings += 1
            self._limits /= 2
            self.index = self._before
        self._start, self._before = tcp_in_base, self.index
        ahead = inverse(tcp_in_base)[None] @ self._poses[self.index :]
        turns = Rotation.from_matrix(ahead[:, :3, :3]).magnitude()
        joints = np.abs(self._path[self.index :] - self._path[self.index]).max(axis=1)
        sizes = np.stack([np.abs(ahead[:, :3, 3]).max(axis=1), turns, joints])
        fits = np.asarray((sizes <= self._limits[:, None]).all(axis=0))
        if fits[0]:
            self.index += len(fits) - 1 if fits.all() else int(np.argmin(fits)) - 1
            self._goal = self._poses[self.index]
        else:
            part = float((self._limits[:2] / np.maximum(sizes[:2, 0], 1e-9)).min())
            turn = Rotation.from_rotvec(part * Rotation.from_matrix(ahead[0, :3, :3]).as_rotvec())
            self._goal = tcp_in_base @ from_rotation(part * ahead[0, :3, 3], turn.as_matrix())
        return self._goal

    def measure_distance(self, tcp_in_base: Array) -> float:
        """Return the distance of a pose (4, 4) from the present pose of the path, m."""
        return float(np.linalg.norm(tcp_in_base[:3, 3] - self._poses[self.index][:3, 3]))

    def _has_stayed(self, start: Array, tcp_in_base: Array) -> bool:
        """Return whether less than half of the last motion, from the pose ``start`` (4, 4), was executed."""
        commanded = float(np.linalg.norm(self._goal[:3, 3] - start[:3, 3]))
        moved = float(np.linalg.norm(tcp_in_base[:3, 3] - start[:3, 3]))
        return commanded > _LEAST_MOTION and moved < 0.5 * commanded
