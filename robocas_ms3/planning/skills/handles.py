"""Open a door or drawer by its handle: take hold of it, pull along its joint, let go, step back.

The gripper only presses on the bar; what moves the door is contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mani_skill.utils.structs import Articulation
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.kinematics import joint_motion
from robocas_ms3.assets.manifest import Handle, Joint
from robocas_ms3.errors import PlanningFailed
from robocas_ms3.planning.protocol import Array, Trajectory
from robocas_ms3.planning.pulling import reached, track, turned_about_bar
from robocas_ms3.planning.scene import SPACING, inverse
from robocas_ms3.planning.skills.arm import Arm, moved_back
from robocas_ms3.planning.timing import through, timed
from robocas_ms3.robots.constants import ARM_ACCELERATION_LIMIT, ARM_VELOCITY_LIMIT
from robocas_ms3.scenes.placement import transform
from robocas_ms3.tasks import terms
from robocas_ms3.tasks.contacts import contact_forces

PULLS = 3  # with a new hold each, where one doesn't open far enough
FAR_SHARE = {"prismatic": 0.95, "revolute": 0.8}  # of the joint's range, where a pull ends at most
LEAST_SHARE = 0.25  # of the range; a pull that can't even do this is not worth it
STEP = {"prismatic": 0.015, "revolute": 0.03}  # m, rad between poses of a pull
SHIFTS = (0.0, -0.03, 0.03)  # m along the bar
TURNS = np.deg2rad((0, -20, 20, -40, 40))  # about the bar
STANDOFF = 0.08  # m that the gripper comes in straight
RETREATS = (0.15, 0.10, 0.06)  # m straight back; the first one that can be reached
CUT = 0.06  # m around the place held, within which the gripper may be near the part it pulls
PULLS_PLANNED = 8  # ways to hold the handle that motions are planned for
CHECKED = 6  # positions of the part at which the arm is checked against it
SPEED = 0.8  # share of the arm's limits


@dataclass(frozen=True)
class Part:
    """What is opened: a moving part of a piece of furniture."""

    furniture: str
    handle: Handle
    joint: Joint

    @classmethod
    def of(cls, arm: Arm) -> Part:
        """The part that the task wants opened."""
        model = arm.env.model
        opening, joint = model.config.opening, model.opened_joint
        assert opening is not None  # the task has one
        assert joint is not None
        return cls(opening.furniture, model.furniture[opening.furniture].asset.handles[opening.handle], joint)

    @property
    def end(self) -> float:
        """Limit of the joint that it opens towards, m or rad."""
        return max(self.joint.limits, key=abs)

    def position(self, arm: Arm) -> float:
        """Where the joint stands, m or rad."""
        return arm.scene.joint_positions(self.furniture)[self.joint.name]

    def in_base(self, arm: Arm, positions: Array) -> Array:
        """4x4 poses (T, 4, 4) of the part's frame in the arm's base frame, at joint positions (T,)."""
        frame = inverse(arm.scene.arm_base_in_world) @ arm.env.model.furniture_poses[self.furniture]
        return np.array([frame @ joint_motion(self.joint, float(q)) for q in positions])

    @property
    def hold(self) -> Array:
        """4x4 TCP that holds the handle squarely, in the part's frame."""
        w, x, y, z = self.handle.wxyz
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), self.handle.position
        return pose

    def pressed(self, arm: Arm) -> bool:
        """Whether both fingers press on the part."""
        env = arm.env
        furniture = env.fixtures.furniture[self.furniture]
        assert isinstance(furniture, Articulation)
        link = furniture.links_map[self.handle.link]
        left, right = env.agent.finger1_link, env.agent.finger2_link
        forces = contact_forces(env.scene, [left, right], [link])
        closing = left.pose.to_transformation_matrix()[:, :3, 1]
        return bool(terms.finger_grasps(forces[:, 0], forces[:, 1], closing)[0, 0])


@dataclass(frozen=True)
class PullPlan:
    """Motions from where the arm is to an opened part."""

    reach: Trajectory
    approach: Trajectory
    pull: Trajectory


def open_part(arm: Arm) -> None:
    """Open what the task wants opened, by as many pulls as it takes.

    Raises:
        PlanningFailed: no pull can be planned, the handle was missed or lost.
    """
    part = Part.of(arm)
    for _ in range(PULLS):
        pull(arm, part)
        if arm.env.task_stages()["furniture_opened"][0]:
            return
    raise PlanningFailed("pull", "not_far_enough")


def pull(arm: Arm, part: Part) -> None:
    """Take hold of the handle, pull as far as the arm leads, let go and step back.

    Raises:
        PlanningFailed: it can't be planned, or the handle was missed or lost.
    """
    with arm.planning():
        plan = plan_pull(arm, part)
    before = part.position(arm)
    arm.follow(plan.reach, plan.approach)
    arm.close_gripper()
    if not part.pressed(arm):
        raise PlanningFailed("handle", "missed")
    arm.follow(plan.pull)
    if abs(part.position(arm) - before) < 0.5 * LEAST_SHARE * abs(part.end):
        raise PlanningFailed("pull", "slipped")
    arm.open_gripper()
    with arm.planning():
        arm.hold_nothing()
        back = _plan_retreat(arm)
    arm.follow(back)


def plan_pull(arm: Arm, part: Part) -> PullPlan:
    """Plan the hold that leads furthest.

    Raises:
        PlanningFailed: of the hold that came last.
    """
    start = part.position(arm)
    far = FAR_SHARE[part.joint.kind] * part.end
    count = max(2, int(np.ceil(abs(far - start) / STEP[part.joint.kind])) + 1)
    positions = np.linspace(start, far, count)
    paths, ends = _paths(arm, part, positions)
    least = LEAST_SHARE * abs(part.end) / abs(far - start) * count
    # the furthest first, in coarse steps; of those the nearest to where the arm is
    order = np.lexsort((np.abs(paths[0] - arm.at).max(axis=1) + arm.rng.uniform(0, 0.5, len(ends)), -ends // 5))
    order = [i for i in order if ends[i] >= min(least, count)]
    if not order:
        raise PlanningFailed("pull", "unreachable")
    everything = arm.scene.obstacles_in_base()
    others = arm.scene.obstacles_in_base(without_link=(part.furniture, part.handle.link))
    failure = PlanningFailed("pull", "no_plan")
    for index in order[:PULLS_PLANNED]:
        path = paths[: ends[index], index]
        try:
            free = _free_length(arm, part, path, positions, others)
            if free < least:
                raise PlanningFailed("pull", "blocked")
            arm.planner.set_scene(everything)
            away = arm.planner.plan_straight(path[0], moved_back(arm.planner.tcp(path[0]), STANDOFF), stage="approach")
            reach = arm.planner.plan_to_qpos(arm.at, [away.qpos[-1]], stage="reach")
            return PullPlan(reach, _reversed(away, path[0]), _timed(path[:free], away.dt))
        except PlanningFailed as error:
            failure = error
    raise failure


def _paths(arm: Arm, part: Part, positions: Array) -> tuple[Array, NDArray[np.int_]]:
    """Configurations (T, N, 7) for many ways to hold the handle, and how many of the T poses (N,) each reaches."""
    frames, goals, starts = part.in_base(arm, positions), [], []
    for shift in SHIFTS:
        for half_turn in (False, True):
            hold = part.hold @ np.diag([-1.0, -1, 1, 1]) if half_turn else part.hold
            hold[:3, 3] += shift * part.hold[:3, 0]
            for turn in TURNS:
                goals.append(frames @ hold)
                starts.append(turned_about_bar(goals[-1][0], turn))
    held = np.stack(goals, axis=1)
    solved, qpos = arm.reachability.reachable(np.array(starts), arm.at)
    if not solved.any():
        raise PlanningFailed("handle", "unreachable")
    path = track(arm.reachability, qpos[solved], held[:, solved])
    return path, reached(path)


def _free_length(arm: Arm, part: Part, path: Array, positions: Array, others: Array) -> int:
    """How many configurations of a path (T, 7) keep clear, of everything else and of the part itself."""
    planner, width = arm.planner, part.handle.width
    planner.set_scene(others)
    length = len(path)
    for i in range(0, len(path), 3):
        if planner.collisions(path[i], width):
            length = i
            break
    points = arm.env.model.furniture[part.furniture].links[part.handle.link].surface_points(SPACING)
    for i in np.linspace(0, length - 1, CHECKED).round().astype(int) if length else ():
        frame = part.in_base(arm, positions[i : i + 1])[0]
        cloud = transform(frame, points)
        planner.set_scene(cloud[np.linalg.norm(cloud - planner.tcp(path[i])[:3, 3], axis=1) > CUT])
        if planner.collisions(path[i], width):
            return int(i * (1 - 1 / CHECKED))
    return length


def _timed(path: Array, dt: float) -> Trajectory:
    motion = timed(
        through(path), velocity=SPEED * ARM_VELOCITY_LIMIT, acceleration=SPEED * ARM_ACCELERATION_LIMIT, dt=dt
    )
    if motion is None:
        raise PlanningFailed("pull", "timing_failed")
    return motion


def _reversed(motion: Trajectory, start: Array) -> Trajectory:
    """A motion that began at ``start``, run backwards."""
    return Trajectory(np.concatenate([motion.qpos[-2::-1], start[None]]), motion.dt)


def _plan_retreat(arm: Arm) -> Trajectory:
    """Plan straight back from the handle, free of everything if possible."""
    arm.planner.set_scene(arm.scene.obstacles_in_base())
    tcp = arm.planner.tcp(arm.at)
    goals = [moved_back(tcp, distance) for distance in RETREATS]
    try:
        return arm.first_line(arm.at, goals, stage="retreat")
    except PlanningFailed:
        return arm.first_line(arm.at, goals, stage="retreat", check_collisions=False)
