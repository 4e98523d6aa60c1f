"""Drive the mobile base with a fixed arm: candidate base poses and collision-free routes.

Base poses are joint positions (3,): x m, y m, yaw rad, in the frame of the robot's root on the floor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import from_wxyz, from_xyz_yaw, transform_points
from robocas_ms3.planning.protocol import Array, Obstacle
from robocas_ms3.planning.scene import to_arm_base_frame
from robocas_ms3.planning.skills.arm import Arm
from robocas_ms3.planning.time_parameterization import time_with_stops
from robocas_ms3.robots.description import Limits, RobotDescription
from robocas_ms3.scenes import robot_placement

SPEED, ACCELERATION = 0.25, 0.4  # m/s and rad/s; m/s^2 and rad/s^2
SETTLE_SECONDS = 0.4
MAX_BASE_ERROR = 0.01  # m, rad
CHECK_STEP = 0.08  # m or rad between collision checks of a drive
THINNED = 3  # stride over points of clouds; gaps stay below 2 cm
LIMIT_MARGIN = 0.01  # m, rad
MAX_YAW = 0.6  # rad
SAMPLES, POSES_SCORED = 400, 14  # base poses drawn, and scored
DISTANCES = (0.45, 0.80)  # m, minimum and maximum horizontal distance from the arm's base to the goal
BEST_DISTANCE = 0.58
BACK_DISTANCES = (0.15, 0.30)  # m straight back before or after the rest of the route


@dataclass(frozen=True)
class Surroundings:
    """Obstacles of a drive, in the world frame.

    Attributes:
        obstacles: bodies for the collision checks of the arm.
        cloud: (P, 3) surface points for the collision checks of the mobile base, m.
    """

    obstacles: list[Obstacle]
    cloud: Array


def read_surroundings(arm: Arm, *, exclude: int | tuple[()] = ()) -> Surroundings:
    cloud = arm.scene.points_in_base(exclude=exclude, radius=np.inf)[::THINNED]
    obstacles = arm.scene.obstacles_in_world(exclude=exclude)
    return Surroundings(obstacles, transform_points(arm.scene.arm_base_in_world, cloud))


def current_base_pose(arm: Arm) -> Array:
    return np.array(arm.executor.base, dtype=float)


def arm_base_in_world(arm: Arm, base: Array) -> Array:
    """Return the pose (4x4) of the arm's base in the world for a base pose (3,)."""
    root = from_wxyz(arm.env.agent.robot.pose.raw_pose[0])
    return root @ from_xyz_yaw(float(base[0]), float(base[1]), arm.robot.arm_base_height, float(base[2]))


def drive(arm: Arm, *goals: Array) -> None:
    """Drive straight to base poses (3,), one after the other.

    The robot waits at each pose until the base settles.

    Raises:
        PlanningError: reason ``blocked``: the base did not reach its goal.
    """
    for goal in goals:
        if np.abs(goal - current_base_pose(arm)).max() < 1e-6:
            continue
        motion = time_with_stops(
            np.array([current_base_pose(arm), goal]), velocity=SPEED, acceleration=ACCELERATION, dt=arm.executor.dt
        )
        wait = np.repeat(goal[None], max(1, round(SETTLE_SECONDS / arm.executor.dt)), axis=0)
        arm.executor.drive(np.concatenate([motion.qpos, wait]), arm.qpos)
        actual = arm.env.agent.robot.get_qpos()[0, :3].cpu().numpy()
        if np.abs(actual - goal).max() > MAX_BASE_ERROR:
            raise PlanningError("drive", "blocked")


def sample_base_poses(arm: Arm, center: Array) -> Array:
    """Sample base poses (N, 3) that face a point (3,) in the world, the best first.

    The arm's base is at a comfortable distance from the point.
    """
    low, high = np.array(arm.robot.base_limits).T + np.array([[LIMIT_MARGIN], [-LIMIT_MARGIN]])
    high[2], low[2] = MAX_YAW, -MAX_YAW
    goals = arm.rng.uniform(low, high, (SAMPLES, 3))
    frames = np.array([arm_base_in_world(arm, goal) for goal in goals])
    distance = np.linalg.norm((frames[:, :2, 3] - center[:2]), axis=1)
    ahead = np.einsum("ni,ni->n", frames[:, :2, 0], center[:2] - frames[:, :2, 3]) / distance
    order = np.argsort(np.abs(distance - BEST_DISTANCE) + 0.2 * np.linalg.norm(goals - current_base_pose(arm), axis=1))
    possible = (distance > DISTANCES[0]) & (distance < DISTANCES[1]) & (ahead > 0.7)
    return goals[order[possible[order]]]


def find_best_route(
    arm: Arm, goals: Array, around: Surroundings, score_pose: Callable[[Array], float], *, enough: float
) -> list[Array]:
    """Return the route to the base pose with the greatest score.

    Scores are computed for the first ``POSES_SCORED`` collision-free base poses.

    Args:
        arm: context of the attempt.
        goals: (N, 3) candidate base poses, the most promising first.
        around: obstacles.
        score_pose: function that returns the score of a base pose (3,); 0 means unusable.
        enough: a reachable pose with at least this score ends the evaluation.

    Returns:
        Base poses (3,) of the route, without the present base pose.

    Raises:
        PlanningError: reason ``no_base_pose``.
    """
    best: tuple[float, list[Array]] = (0.0, [])
    scored = 0
    for goal in goals:
        if not is_base_clear(arm.robot, arm_base_in_world(arm, goal), around.cloud):
            continue
        scored += 1
        if scored > POSES_SCORED:
            break
        score = score_pose(goal)
        if score > best[0] and (route := find_free_route(arm, current_base_pose(arm), goal, around, back_first=False)):
            best = score, route
            if score >= enough:
                break
    if not best[1]:
        raise PlanningError("drive", "no_base_pose")
    return best[1]


def find_free_route(
    arm: Arm, start: Array, goal: Array, around: Surroundings, *, back_first: bool
) -> list[Array] | None:
    """Return base poses (3,) of a collision-free route from ``start`` to ``goal``, or None.

    The route is straight, or goes via a pose 15 or 30 cm straight behind one of its ends. With ``back_first`` this end
    is ``start``: the robot first drives straight back. Otherwise it is ``goal``: the robot drives straight forward at
    the end.
    """
    for route in _generate_routes(start, goal, back_first, arm.robot.base_limits):
        poses = [start, *route]
        if all(_is_leg_free(arm, a, b, around) for a, b in zip(poses[:-1], poses[1:], strict=True)):
            return route
    return None


def _generate_routes(start: Array, goal: Array, back_first: bool, limits: Limits) -> Iterator[list[Array]]:
    yield [goal]
    narrow = start if back_first else goal
    for distance in BACK_DISTANCES:
        via = narrow - distance * np.array([np.cos(narrow[2]), np.sin(narrow[2]), 0])
        if all(a <= v <= b for v, (a, b) in zip(via, limits, strict=True)):
            yield [via, goal]


def _is_leg_free(arm: Arm, start: Array, goal: Array, around: Surroundings) -> bool:
    count = max(2, int(np.ceil(np.abs(goal - start).max() / CHECK_STEP)) + 1)
    width = arm.planner.finger_width
    for pose in np.linspace(start, goal, count)[1:]:
        frame = arm_base_in_world(arm, pose)
        if not is_base_clear(arm.robot, frame, around.cloud):
            return False
        arm.planner.set_scene(to_arm_base_frame(around.obstacles, frame))
        if arm.planner.find_collisions(arm.qpos, width):
            return False
    return True


def is_base_clear(robot: RobotDescription, arm_base_in_world: Array, cloud: Array) -> bool:
    """Return whether no point of ``cloud`` (P, 3), world frame, is inside the body; see `scenes.robot_placement`."""
    root = arm_base_in_world.copy()
    root[2, 3] -= robot.arm_base_height  # on the floor
    return robot_placement.is_body_clear(root, cloud)
