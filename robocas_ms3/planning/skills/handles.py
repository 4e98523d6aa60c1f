"""Open a door or drawer by its handle: grasp the handle, pull along the joint, release, retreat.

Only contact forces between gripper and handle move the door.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from mani_skill.utils.structs import Articulation
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.kinematics import joint_motion
from robocas_ms3.assets.manifest import Handle, Joint
from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import inverse, transform_points
from robocas_ms3.planning.protocol import Array, Obstacle, Shape, Trajectory
from robocas_ms3.planning.pull_path import count_reached_poses, rotate_about_bar, track_handle
from robocas_ms3.planning.scene import SPACING, get_body_shape
from robocas_ms3.planning.skills.arm import Arm, PlannedPrimitive, plan_first_feasible, plan_retreat, shift_back
from robocas_ms3.planning.time_parameterization import fit_spline, time_path
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.scenes.grasp_checks import HALF_TURN
from robocas_ms3.scenes.lookup import MAX_OPENED_FRACTION
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.bodies import read_contact_forces
from robocas_ms3.tasks.open_pick import RoboCASOpenPickEnv

MAX_PULLS = 3  # pulls, each with a new grasp of the handle
COMFORT_FRACTION = 0.15  # extra range beyond "opened", as a fraction of the range up to the longest pull
HANDLE_RADIUS = 0.15  # m around the handle; surface points within it can be between the fingers
PAD_HALF_EXTENT = (0.008, 0.01)  # m from the TCP along x and z: volume between the pads
HOLDS_CHECKED = 4  # handle grasps that are checked for collisions to estimate reach
DEPTH_OFFSET = 0.012  # m by which the bar is deeper in the gripper than the TCP, if it fits
SHIFTS = (0.0, -0.03, 0.03)  # m along the bar
TURNS = np.deg2rad((0, -20, 20, -40, 40))  # about the bar
TURN_WEIGHT = 1.0  # cost of a rotation about the bar relative to a joint displacement; tilted pads push the bar aside
STANDOFF = 0.08  # m, straight approach
RETREATS = (0.15, 0.10, 0.06)  # m straight back; the first reachable one is used
HANDLE_CLEARANCE = 0.06  # m around the handle, without collision checks against the pulled part
PULLS_PLANNED = 8  # handle grasps to plan motions for
POSITIONS_CHECKED = 6  # joint positions of the part at which the arm is checked against it
SPEED = 0.8  # fraction of the arm's limits
MIN_RANGE_FRACTION = 0.25  # minimum length of a pull, as a fraction of the joint range
STEP = {"prismatic": 0.015, "revolute": 0.03}  # m, rad between poses of a pull


@dataclass(frozen=True)
class MovingPart:
    """Door or drawer that the task opens.

    Attributes:
        furniture: name of the piece of furniture.
        handle: handle of the door or drawer.
        joint: joint of the door or drawer.
        grasp_offset: (4x4) pose of the planned grasp relative to the handle's own grasp pose; unless it is the
            identity, the grasp may miss the handle.
    """

    furniture: str
    handle: Handle
    joint: Joint
    grasp_offset: Array = field(default_factory=lambda: np.eye(4))

    @classmethod
    def from_task(cls, arm: Arm) -> MovingPart:
        """Return the door or drawer that the task of the arm's environment opens."""
        model = arm.env.model
        opening, joint = model.config.opening, model.joint_to_open
        assert opening is not None  # required by the task
        assert joint is not None
        return cls(opening.furniture, model.furniture[opening.furniture].asset.handles[opening.handle], joint)

    @property
    def open_limit(self) -> float:
        """Joint limit in the opening direction, m or rad."""
        return max(self.joint.limits, key=abs)

    def joint_position(self, arm: Arm) -> float:
        """Return the joint position, m or rad."""
        return arm.scene.joint_positions(self.furniture)[self.joint.name]

    def pull_positions(self, arm: Arm) -> Array:
        """Return joint positions (T,) of the longest pull, from the present position on, m or rad.

        Raises:
            PlanningError: reason ``already_open``: the longest pull is shorter than one step.
        """
        start, far = self.joint_position(arm), MAX_OPENED_FRACTION[self.joint.kind] * self.open_limit
        left = (far - start) * np.sign(far)
        if left < STEP[self.joint.kind]:
            raise PlanningError("pull", "already_open")
        return np.linspace(start, far, int(np.ceil(left / STEP[self.joint.kind])) + 1, dtype=np.float64)

    def min_pull(self, arm: Arm) -> float:
        """Return the minimum useful length of a pull, m or rad."""
        positions = self.pull_positions(arm)
        return min(MIN_RANGE_FRACTION * abs(self.open_limit), abs(positions[-1] - positions[0]))

    def poses_in_world(self, arm: Arm, positions: Array) -> Array:
        """Return world poses (T, 4, 4) of the part at joint positions (T,)."""
        frame = arm.env.model.furniture_poses[self.furniture]
        return np.array([frame @ joint_motion(self.joint, float(q)) for q in positions])

    def obstacle(self, arm: Arm, pose_in_base: Array) -> Obstacle:
        part = arm.env.model.furniture[self.furniture].links[self.handle.link]
        return Obstacle(self.handle.link, get_body_shape(part), pose_in_base)

    def surface_points(self, arm: Arm) -> Array:
        return arm.env.model.furniture[self.furniture].links[self.handle.link].surface_points(SPACING)

    @property
    def grasp_in_part(self) -> Array:
        """TCP pose (4x4) in the part's frame with the gripper perpendicular to the handle."""
        w, x, y, z = self.handle.wxyz
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), self.handle.position
        return pose @ self.grasp_offset

    def is_grasped(self, arm: Arm) -> bool:
        """Return whether both fingers press on the part."""
        env = arm.env
        furniture = env.fixtures.furniture[self.furniture]
        assert isinstance(furniture, Articulation)
        link = furniture.links_map[self.handle.link]
        left, right = env.agent.finger1_link, env.agent.finger2_link
        forces = read_contact_forces(env.scene, [left, right], [link])
        closing = left.pose.to_transformation_matrix()[:, :3, 1]
        return bool(terms.is_grasped(forces[:, 0], forces[:, 1], closing)[0, 0])


def open_furniture_part(arm: Arm) -> None:
    """Open the door or drawer of the task by up to ``MAX_PULLS`` pulls.

    Raises:
        PlanningError: a pull fails, or the door or drawer is not open after the last pull.
    """
    part = MovingPart.from_task(arm)
    for _ in range(MAX_PULLS):
        arm.run_first_candidate("pull", lambda: pull_handle(arm, part))
        if is_opened(arm):
            return
    raise PlanningError("pull", "not_far_enough")


def is_opened(arm: Arm) -> bool:
    """Return whether the door or drawer of the task is open far enough."""
    env = arm.env
    assert isinstance(env, RoboCASOpenPickEnv)
    return bool(env.is_furniture_open()[0])


def pull_handle(arm: Arm, part: MovingPart) -> None:
    """Grasp the handle, pull it as far as the arm reaches, release it and retreat."""
    with arm.planning_time():
        approach, opening = plan_pull(arm, part)
        ends = (arm.planner.tcp(motion.qpos[-1]) for motion in (approach, opening))
        arm.planned = PlannedPrimitive("pull", -1, *ends)
        before, least = part.joint_position(arm), 0.5 * part.min_pull(arm)
    arm.follow(approach)
    arm.close_gripper()
    if not part.is_grasped(arm):
        raise PlanningError("handle", "missed")
    arm.follow(opening)
    if abs(part.joint_position(arm) - before) < least:
        raise PlanningError("pull", "slipped")
    arm.open_gripper()
    with arm.planning_time():
        arm.clear_attached()
        arm.planner.set_scene(arm.scene.obstacles())
        goals = [shift_back(arm.planner.tcp(arm.qpos), distance) for distance in RETREATS]
        check_collisions = (True, False)  # collision-free if possible
        back = plan_first_feasible(
            check_collisions,
            lambda check: arm.plan_first_line(arm.qpos, goals, stage="retreat", check_collisions=check),
            PlanningError("retreat", "no_goals"),
        )
    arm.follow(back)


def plan_pull(arm: Arm, part: MovingPart) -> tuple[Trajectory, Trajectory]:
    """Plan the motion to a grasp of the handle, and the longest pull.

    The bar of the handle is ``DEPTH_OFFSET`` behind the TCP, towards the palm, if possible.

    Returns:
        Motion to the grasp; pull.
    """
    failure = PlanningError("pull", "no_plan")
    return plan_first_feasible((DEPTH_OFFSET, 0.0), lambda depth_offset: _plan_pull(arm, part, depth_offset), failure)


def _plan_pull(arm: Arm, part: MovingPart, depth_offset: float) -> tuple[Trajectory, Trajectory]:
    positions = part.pull_positions(arm)
    frames = inverse(arm.scene.arm_base_in_world) @ part.poses_in_world(arm, positions)
    paths, ends, turned = _compute_paths(arm, part, frames, depth_offset)
    least = part.min_pull(arm) / abs(positions[-1] - positions[0]) * len(positions)
    # the longest pull first, in coarse steps; then the squarest grasp nearest to the current configuration
    cost = np.abs(paths[0] - arm.qpos).max(axis=1) + TURN_WEIGHT * turned + arm.rng.uniform(0, 0.3, len(ends))
    order = np.lexsort((cost, -ends // 5))
    order = [i for i in order if ends[i] >= least]
    if not order:
        raise PlanningError("pull", "unreachable")
    everything = arm.scene.obstacles()
    others = arm.scene.obstacles(exclude_link=(part.furniture, part.handle.link))
    order = _filter_grasps(arm, part, paths[0], order, frames, others, depth_offset)
    if not order:
        raise PlanningError("handle", "blocked")

    def plan(index: int) -> tuple[Trajectory, Trajectory]:
        path = paths[: ends[index], index]
        free = _count_free_poses(arm, part, path, frames, others)
        if free < least:
            raise PlanningError("pull", "blocked")
        free = _find_retreatable_length(arm, path[:free], int(np.ceil(least)))
        arm.planner.set_scene(everything)
        away = arm.planner.plan_straight(path[0], shift_back(arm.planner.tcp(path[0]), STANDOFF), stage="approach")
        reach = arm.planner.plan_to_qpos(arm.qpos, [away.qpos[-1]], stage="reach")
        inward = Trajectory(np.concatenate([away.qpos[-2::-1], path[:1]]), away.dt)
        return arm.planner.join(arm.qpos, reach, inward), _time_pull(path[:free], arm.robot, away.dt)

    return plan_first_feasible(order[:PULLS_PLANNED], plan, PlanningError("pull", "no_plan"))


def estimate_pull_fraction(arm: Arm, part: MovingPart, arm_base_in_world: Array, others: list[Obstacle]) -> float:
    """Estimate how far the arm can pull the handle from another base pose, 0 to 1.

    1 means that the pull opens the door or drawer with a margin (``COMFORT_FRACTION``).

    Args:
        arm: context of the attempt.
        part: door or drawer.
        arm_base_in_world: (4x4) pose of the arm's base at the other base pose.
        others: all other bodies, in the frame of that arm's base.
    """
    positions = part.pull_positions(arm)
    opened = arm.env.model.open_threshold
    enough = 1 + int(np.sum(np.abs(positions) < abs(opened + COMFORT_FRACTION * (positions[-1] - opened))))
    frames = inverse(arm_base_in_world) @ part.poses_in_world(arm, positions)
    try:
        paths, ends, _ = _compute_paths(arm, part, frames)
    except PlanningError:
        return 0.0
    fraction = 0.0
    order = [i for i in np.argsort(-ends, kind="stable") if ends[i]]
    for index in _filter_grasps(arm, part, paths[0], order, frames, others)[:HOLDS_CHECKED]:
        path = paths[: ends[index], index]
        if fraction < 1:
            fraction = max(fraction, min(1.0, _count_free_poses(arm, part, path, frames, others) / enough))
    return fraction


def _compute_paths(
    arm: Arm, part: MovingPart, frames: Array, depth_offset: float = 0.0
) -> tuple[Array, NDArray[np.int_], Array]:
    """Compute N paths of the arm that move the part through its poses, one path per grasp of the handle.

    Args:
        arm: context of the attempt.
        part: door or drawer.
        frames: (T, 4, 4) poses of the part during the pull, in the arm's base frame.
        depth_offset: distance of the bar behind the TCP, towards the palm, m.

    Returns:
        Configurations (T, N, 7); number of poses (N,) that each path reaches; rotation (N,) of the gripper about the
        bar in each grasp, rad.
    """
    goals, starts, beyond = [], [], np.eye(4)
    beyond[2, 3] = depth_offset
    for shift in SHIFTS:
        for half_turn in (False, True):
            hold = part.grasp_in_part @ HALF_TURN if half_turn else part.grasp_in_part
            hold[:3, 3] += shift * part.grasp_in_part[:3, 0]
            for turn in TURNS:
                goals.append(frames @ hold)
                starts.append(rotate_about_bar(goals[-1][0], turn) @ beyond)
    held = np.stack(goals, axis=1)
    solved, qpos = arm.inverse_kinematics.nearest_solutions(np.array(starts), arm.qpos)
    if not solved.any():
        raise PlanningError("handle", "unreachable")
    path = track_handle(arm.inverse_kinematics.chain.with_tool_offset(depth_offset), qpos[solved], held[:, solved])
    turned = np.tile(np.abs(TURNS), len(goals) // len(TURNS))[solved]
    return path, count_reached_poses(path), turned


def _filter_grasps(
    arm: Arm,
    part: MovingPart,
    starts: Array,
    order: list[int],
    frames: Array,
    others: list[Obstacle],
    depth_offset: float = 0.0,
) -> list[int]:
    """Return the indices from ``order`` of usable grasps of the handle.

    A usable grasp is collision-free, with the handle between the open fingers.

    ``starts`` (N, 7) has the configurations of all grasps; ``order`` has indices of ``starts``, the best first.
    """
    surface = transform_points(frames[0], part.surface_points(arm))
    near = surface[np.linalg.norm(surface - (frames[0] @ part.grasp_in_part)[:3, 3], axis=1) < HANDLE_RADIUS]
    arm.planner.set_scene([*others, part.obstacle(arm, frames[0])])

    width = arm.robot.open_width

    def has_handle_between_pads(start: Array) -> bool:
        bar = transform_points(inverse(arm.planner.tcp(start)), near) + (0, 0, depth_offset)
        between = np.abs(bar) < (PAD_HALF_EXTENT[0], width / 2, PAD_HALF_EXTENT[1])
        return bool(between.all(axis=1).any())

    if np.array_equal(part.grasp_offset, np.eye(4)):
        order = [i for i in order if has_handle_between_pads(starts[i])]
    if not order:
        return []
    return [i for i, free in zip(order, arm.planner.is_free(starts[order], width), strict=True) if free]


def _count_free_poses(arm: Arm, part: MovingPart, path: Array, frames: Array, others: list[Obstacle]) -> int:
    """Return the number of configurations of a path (T, 7) before the first collision.

    At each configuration the part is at the pose in ``frames`` (T, 4, 4).
    """
    planner, width = arm.planner, part.handle.width
    planner.set_scene(others)
    blocked = np.flatnonzero(~planner.is_free(path[::3], width))
    length = 3 * int(blocked[0]) if len(blocked) else len(path)
    if not length:
        return 0
    points, held = part.surface_points(arm), transform_points(inverse(frames[0]), planner.tcp(path[0])[None, :3, 3])
    rest = Shape(points=points[np.linalg.norm(points - held, axis=1) > HANDLE_CLEARANCE])
    for i in np.linspace(0, length - 1, POSITIONS_CHECKED).round().astype(int):
        planner.set_scene([Obstacle(part.handle.link, rest, frames[i])])
        if planner.find_collisions(path[i], width):
            return int(i * (1 - 1 / POSITIONS_CHECKED))
    return length


def _find_retreatable_length(arm: Arm, path: Array, least: int) -> int:
    """Return the greatest length of a pull after which the gripper can retreat.

    The length is a number of configurations of ``path`` (T, 7).

    Raises:
        PlanningError: reason ``no_retreat``: there is no such length of at least ``least`` configurations.
    """
    for length in range(len(path), max(least, 1) - 1, -3):
        tcp = arm.planner.tcp(path[length - 1])
        try:
            plan_retreat(arm, path[length - 1], [shift_back(tcp, distance) for distance in RETREATS])
            return length
        except PlanningError:
            continue
    raise PlanningError("pull", "no_retreat")


def _time_pull(path: Array, robot: RobotDescription, dt: float) -> Trajectory:
    motion = time_path(
        fit_spline(path),
        velocity=SPEED * robot.arm_velocity_limit,
        acceleration=SPEED * robot.arm_acceleration_limit,
        dt=dt,
    )
    if motion is None:
        raise PlanningError("pull", "no_time_parameterization")
    return motion
