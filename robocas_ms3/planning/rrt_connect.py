"""Plan motions by RRT-Connect, straight lines and time parameterisation, with collision checks by FCL."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.extensions import Registry
from robocas_ms3.planning.collision import CollisionChecker
from robocas_ms3.planning.kinematics import InverseKinematics, joint_distance, solve_straight_line
from robocas_ms3.planning.path_search import PathSearch
from robocas_ms3.planning.protocol import Array, Planner, Trajectory
from robocas_ms3.planning.time_parameterization import (
    JointPath,
    blend_motions,
    fit_spline,
    round_corners,
    thin_path,
    time_path,
    time_with_stops,
)
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.robots.registry import RobotSpec

BUDGET = 20_000  # collision checks per search, about 2 s; a time limit would depend on the load of the machine
RRT_RANGE = 0.25  # rad, maximum extension of a tree
SPACING = 0.03  # rad between checks during the search
FINE_SPACING = 0.01  # rad between checks of the final path
CORNER_RADII = (0.3, 0.1, 0.03)  # rad; smaller radii are tried if a rounded corner collides
DETOUR = 1.5  # maximum length of a straight motion to another goal, relative to the nearest goal (+ 0.5 rad)
BLENDS = (0.9, 0.5)  # s, overlap of a motion and the next one
BLEND_SPACING = 0.05  # rad between spline points of a blended motion
SHORTCUTS = 40
MIN_MOTION = 1e-6  # rad; a shorter motion has a single row
TCP_SPEED_LIMIT = 0.45  # m/s; pd_ee_delta_pose at 5 Hz moves at most 0.1 m per step and has to catch up its lag

Timed = TypeVar("Timed", Trajectory, Trajectory | None)


class RRTConnectPlanner(CollisionChecker):
    """Motion planner for an arm: RRT-Connect, straight lines and TOPP-RA.

    Poses are in the arm's base frame. `protocol.Planner` documents the methods without a docstring.

    Args:
        urdf: URDF of the arm alone, with the arm's base as its root link.
        srdf: SRDF with the pairs of links that need no collision check.
        robot: description of the robot.
        dt: time between rows of a trajectory, s.
    """

    def __init__(self, urdf: Path | str, srdf: Path | str, *, robot: RobotDescription, dt: float) -> None:
        import toppra  # noqa: F401  (takes 0.2 s; import before this process forks)

        super().__init__(urdf, srdf, robot)
        self._reachability = InverseKinematics(self.chain)
        self._dt = dt
        self._limits = {"velocity": robot.arm_velocity_limit, "acceleration": robot.arm_acceleration_limit}
        lower, upper = self.chain.lower, self.chain.upper
        self._search = PathSearch(self.count_leading_free, lower, upper, step=RRT_RANGE, spacing=SPACING)
        self._rng = np.random.default_rng(0)

    def seed(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def ik(self, tcp_in_base: Array, near: Array, *, avoid_collisions: bool = True) -> list[Array]:
        near = np.asarray(near, dtype=np.float64)
        found = self._reachability.distinct_solutions(tcp_in_base, near)
        if not avoid_collisions or not found:
            return found
        return [qpos for qpos, ok in zip(found, self.is_free(np.array(found), self.finger_width), strict=True) if ok]

    def plan_to_pose(self, start: Array, tcp_in_base: Array, *, stage: str) -> Trajectory:
        """Plan a collision-free motion from ``start`` (7,) that ends with the TCP at a pose (4x4).

        Raises:
            PlanningError: ``no_ik`` (the pose is out of reach), or a reason of `plan_to_qpos`.
        """
        goals = self.ik(tcp_in_base, start, avoid_collisions=False)
        if not goals:
            raise PlanningError(stage, "no_ik")
        return self.plan_to_qpos(start, goals, stage=stage)

    def plan_to_qpos(self, start: Array, goals: list[Array], *, stage: str, straight_only: bool = False) -> Trajectory:
        """Plan a collision-free motion to one of several goal configurations (7,).

        The planner first tries straight motions in joint space, nearest goal first. Then it searches paths by
        RRT-Connect, unless ``straight_only`` is set.

        Raises:
            PlanningError: one of these reasons.
                ``start_in_collision``, ``start_outside_limits``: the start is unusable.
                ``no_goals``, ``goal_outside_limits``, ``goal_in_collision``: no goal is given, all goals violate the
                joint limits, or all remaining goals collide.
                ``not_straight``: all straight motions collide, and ``straight_only`` is set.
                ``rrt_timeout``: no path found with ``BUDGET`` collision checks.
                ``path_blocked``: the path found collides after rounding its corners.
        """
        start = self._checked_start(start, stage)
        candidates = np.array(goals, dtype=np.float64).reshape(-1, 7)
        if not len(candidates):
            raise PlanningError(stage, "no_goals")
        lower, upper = self.chain.limits.T
        candidates = candidates[np.all((candidates >= lower) & (candidates <= upper), axis=1)]
        if not len(candidates):
            raise PlanningError(stage, "goal_outside_limits")
        candidates = candidates[self.is_free(candidates, self.finger_width)]
        if not len(candidates):
            raise PlanningError(stage, "goal_in_collision")
        free = list(candidates[np.argsort(joint_distance(candidates, start), kind="stable")])
        if np.linalg.norm(free[0] - start) < MIN_MOTION:
            return Trajectory(free[0][None].copy(), self._dt)
        enough = DETOUR * joint_distance(free[0], start) + 0.5
        for goal in free:
            if joint_distance(goal, start) <= enough and self._is_straight_free(start, goal):
                return self._time_motion(partial(time_with_stops, np.array([start, goal])))
        if straight_only:
            raise PlanningError(stage, "not_straight")
        reason = "rrt_timeout"
        # First the nearest goal with a small budget, then all goals with the full budget. If a path collides between
        # checks, search again with the spacing of the final check.
        for roots, budget, spacing in (
            (free[:1], BUDGET // 10, SPACING),
            (free, BUDGET, SPACING),
            (free, BUDGET, FINE_SPACING),
        ):
            if spacing == FINE_SPACING and reason == "rrt_timeout":
                break
            self._search.spacing = spacing
            path = self._search.connect(start, roots, self._rng, max_checks=budget)
            if path is None:
                continue
            path = self._search.shorten(path, self._rng, tries=SHORTCUTS, max_checks=BUDGET // 4)
            trajectory = self._smooth_and_time(path)
            if trajectory is not None:
                return trajectory
            reason = "path_blocked"
        raise PlanningError(stage, reason)

    def plan_straight(
        self, start: Array, tcp_in_base: Array, *, stage: str, check_collisions: bool = True, speed: float = 1.0
    ) -> Trajectory:
        """Plan a motion of the TCP on a straight line, with the shortest rotation, to a pose (4x4).

        Raises:
            PlanningError: one of these reasons.
                ``start_in_collision``, ``start_outside_limits``: the start is unusable.
                ``line_unreachable``: a pose on the line is out of reach.
                ``line_joint_jump``: a joint would have to jump on the line.
                ``straight_line_blocked``: the line collides.
                ``no_time_parameterization``: TOPP-RA finds no timing within the limits.
        """
        start = self._checked_start(start, stage, obstacles=check_collisions)
        waypoints = solve_straight_line(self.chain, start, np.asarray(tcp_in_base, dtype=np.float64), stage=stage)
        if np.linalg.norm(waypoints[-1] - start) < MIN_MOTION:
            return Trajectory(waypoints[-1:].copy(), self._dt)
        path = fit_spline(waypoints)
        if not self._is_spline_free(path, obstacles=check_collisions):
            raise PlanningError(stage, "straight_line_blocked")
        trajectory = self._time_motion(partial(time_path, path), speed)
        if trajectory is None:
            raise PlanningError(stage, "no_time_parameterization")
        return trajectory

    def join(self, start: Array, first: Trajectory, second: Trajectory) -> Trajectory:
        a, b = np.concatenate([np.asarray(start)[None], first.qpos]), second.qpos
        best = Trajectory(np.concatenate([first.qpos, b]), self._dt)
        for seconds in BLENDS:
            rows = min(round(seconds / self._dt), len(a) - 1, len(b) - 1)
            if rows < 1:
                continue
            points = blend_motions(a, b, rows)
            path = fit_spline(thin_path(points, BLEND_SPACING))
            samples, end = path.sample(FINE_SPACING), points[min(len(a), len(points) - 1)]
            lower, upper = self.chain.limits.T  # the sum of two motions may exceed the limits
            # check up to the end of the corner; the rest of the second motion was planned with other obstacles
            corner = int(np.linalg.norm(samples - end, axis=1).argmin()) + 1
            if not np.all((lower <= samples) & (samples <= upper)) or not self.is_path_free(samples[:corner]):
                continue
            trajectory = self._time_motion(partial(time_path, path))
            if trajectory is not None and len(trajectory.qpos) < len(best.qpos):
                return trajectory
        return best

    def _checked_start(self, start: Array, stage: str, *, obstacles: bool = True) -> Array:
        start = np.asarray(start, dtype=np.float64)
        lower, upper = self.chain.limits.T
        if not np.all((lower - 1e-3 <= start) & (start <= upper + 1e-3)):
            raise PlanningError(stage, "start_outside_limits")
        if not self.is_path_free(start[None], obstacles=obstacles):
            raise PlanningError(stage, "start_in_collision")
        return start

    def _is_straight_free(self, start: Array, goal: Array) -> bool:
        return self.is_path_free(start + (goal - start) * _fractions(start, goal)[1:-1, None])

    def _is_spline_free(self, path: JointPath, *, obstacles: bool = True) -> bool:
        return self.is_path_free(path.sample(FINE_SPACING), obstacles=obstacles)

    def _smooth_and_time(self, waypoints: list[Array]) -> Trajectory | None:
        """Round the corners of a path and return it as a trajectory; None if the rounded path collides."""
        points = [waypoints[0]]
        points += [b for a, b in zip(waypoints[:-1], waypoints[1:], strict=True) if np.linalg.norm(b - a) > 1e-4]
        points[-1] = waypoints[-1]
        corners = np.array(points)
        if len(points) == 2 and self._is_straight_free(*points):
            return self._time_motion(partial(time_with_stops, corners))
        for radius in CORNER_RADII:
            path = round_corners(corners, radius)
            if self._is_spline_free(path):
                trajectory = self._time_motion(partial(time_path, path))
                if trajectory is not None:
                    return trajectory
        return self._time_motion(partial(time_with_stops, corners)) if self.is_path_free(_densify(corners)) else None

    def _time_motion(self, time: Callable[..., Timed], speed: float = 1.0) -> Timed:
        """Compute a trajectory by ``time`` with the joint limits times ``speed``.

        If the TCP exceeds its speed limit, ``time`` is called again with lower joint limits.
        """
        limits = {name: value * speed for name, value in self._limits.items()}
        trajectory = time(**limits, dt=self._dt)
        if trajectory is not None and len(trajectory.qpos) > 1:
            positions = self.chain.tcp(trajectory.qpos)[:, :3, 3]
            fastest = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).max()) / self._dt
            if fastest > TCP_SPEED_LIMIT:
                # scale velocities by s and accelerations by s^2, which slows down the whole motion
                slower = TCP_SPEED_LIMIT / fastest
                limits = {"velocity": limits["velocity"] * slower, "acceleration": limits["acceleration"] * slower**2}
                trajectory = time(**limits, dt=self._dt)
        return trajectory


def _densify(points: Array) -> Array:
    return np.concatenate([a + (b - a) * _fractions(a, b)[:, None] for a, b in pairwise(points)])


def _fractions(a: Array, b: Array) -> Array:
    return np.linspace(0, 1, int(np.ceil(np.linalg.norm(b - a) / FINE_SPACING)) + 1, dtype=np.float64)


DEFAULT_PLANNER = "rrt_connect"
PLANNERS: Registry[Callable[..., Planner]] = Registry(
    "planner", "robocas_ms3.planners", Callable, {DEFAULT_PLANNER: RRTConnectPlanner}
)
"""Registry of motion planners; other packages add planners by entry points ``robocas_ms3.planners``."""


def make_planner(name: str, robot: RobotSpec, *, dt: float) -> Planner:
    """Create the registered planner ``name`` for the arm of a robot.

    Args:
        name: name of the planner in `PLANNERS`.
        robot: specification of the robot.
        dt: time between rows of the planned trajectories, s.

    Raises:
        ExtensionError: unknown planner.
    """
    backend, files = PLANNERS.find(name, where="planner"), robot.files()
    return backend(files.arm_urdf, files.arm_srdf, robot=robot.description, dt=dt)
