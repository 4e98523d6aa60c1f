"""Carry a held object above the basket, release it, and retreat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import from_wxyz, inverse, transform_points
from robocas_ms3.planning.kinematics import joint_distance
from robocas_ms3.planning.protocol import Array, AttachedBody, Trajectory
from robocas_ms3.planning.skills.arm import (
    CARRY_CLEARANCE,
    Arm,
    PlannedPrimitive,
    plan_first_feasible,
    plan_retreat,
    shift_back,
    shift_up,
)

DROPS_SAMPLED, DROPS_CHECKED, DROPS_PLANNED = 192, 64, 10
DROP_MARGIN = 0.045  # m, expected position error of a robot at the drop
LEAN_WEIGHT = 0.7  # cost of the gripper's tilt relative to a joint displacement
ELBOW, STRETCHED, STRETCH_WEIGHT = 3, -0.7, 5.0  # joint index; rad of a nearly straight arm; cost per rad
RETREAT_HEIGHT = 0.05  # m (RoboCAS-v0)
RIM_CLEARANCE = (0.03, 0.07)  # m, minimum and maximum height of the object's lowest point above the rim
MAX_TILT_DEG = 70.0  # RoboCAS-v0: 30 to 70
MAX_OFFSET_FRACTION = 0.25  # maximum offset of the centre of mass from the middle, as a fraction of the half size


@dataclass(frozen=True)
class ContainerInterior:
    """Interior of a container, a box in the container's frame.

    Attributes:
        container_in_base: (4x4) pose of the container in the arm's base frame.
        low: (3,) corner of the box with the smallest coordinates, m.
        high: (3,) corner of the box with the greatest coordinates, m.
    """

    container_in_base: Array
    low: Array
    high: Array


def carry_and_release(arm: Arm, slot: int, *, drops: Array | None = None) -> None:
    """Carry a held object to a pose above the basket, release it, and retreat.

    Args:
        arm: context of the attempt.
        slot: slot of the held object.
        drops: (N, 4, 4) TCP poses to try in this order, in the arm's base frame; None: sampled and ranked poses.
    """
    carry_to_basket(arm, slot, drops)
    release_into_basket(arm, slot)


def carry_to_basket(arm: Arm, slot: int, drops: Array | None = None) -> None:
    """Carry a held object to a pose above the basket.

    Args:
        arm: context of the attempt.
        slot: slot of the held object.
        drops: (N, 4, 4) TCP poses to try in this order, in the arm's base frame; None: sampled and ranked poses.

    Raises:
        PlanningError: no motion is found, or the gripper loses the object.
    """
    with arm.planning_time():
        motion = plan_carry(arm, slot, drops)
        arm.planned = PlannedPrimitive("release", slot, arm.planner.tcp(motion.qpos[-1]))
    arm.follow(motion)
    if not arm.is_holding(slot):
        raise PlanningError("transfer", "dropped")


def release_into_basket(arm: Arm, slot: int) -> None:
    """Release the object above the basket, retreat, and move the arm home until the task succeeds.

    Raises:
        PlanningError: the task does not succeed; the reason is the first condition of success that does not hold.
    """
    start = arm.qpos
    arm.open_gripper()
    with arm.planning_time():
        arm.clear_attached()
        arm.planner.set_scene(arm.scene.obstacles(exclude=slot))
        retreat = plan_retreat(arm, start, _retreat_poses(arm.planner.tcp(start)))
        home = arm.plan_home(retreat.qpos[-1])
    arm.follow(retreat)
    # the object settles while the arm moves home; the demonstration ends as soon as it is at rest
    if not arm.follow(home, until="success"):
        raise PlanningError("release", _failure_reason(arm))


def plan_carry(arm: Arm, slot: int, drops: Array | None = None) -> Trajectory:
    """Plan a motion of a held object to a pose above the basket from which the arm can retreat.

    The motion keeps ``CARRY_CLEARANCE`` to basket and furniture if possible.
    """
    is_ranked = drops is not None
    drops = sample_drop_poses(arm, slot, arm.scene.arm_base_in_world) if drops is None else drops
    solved, qpos = arm.inverse_kinematics.nearest_solutions(drops, arm.qpos)
    if not solved.any():
        raise PlanningError("transfer", "unreachable")
    drops, qpos = drops[solved], qpos[solved]
    if not is_ranked:
        order = _rank_drops(arm, slot, drops, qpos)
        drops, qpos = drops[order], qpos[order]
    attach_held_object(arm, slot)

    def plan(clearance: float) -> Trajectory:
        arm.planner.set_scene(arm.scene.obstacles(exclude=slot, clearance=clearance))
        return _plan_to_first_drop(arm, drops, qpos)

    return plan_first_feasible((CARRY_CLEARANCE, 0.0), plan, PlanningError("transfer", "no_plan"))


def _rank_drops(arm: Arm, slot: int, drops: Array, qpos: Array) -> NDArray[np.int_]:
    """Return the order (N,) of drop poses, the best first.

    The object's overhang over the rim of the basket counts first, in steps of 15 mm. Next come the distance from the
    present configuration, the tilt of the gripper, off which an object slides, and the stretch of the arm.

    Args:
        arm: context of the attempt.
        slot: slot of the held object.
        drops: (N, 4, 4) TCP poses above the basket.
        qpos: (N, 7) configurations of the arm at these poses.
    """
    inside = _basket_interior(arm, arm.scene.arm_base_in_world)
    overhang = compute_overhang(drops, inside, transform_points(*read_held_object(arm, slot)), DROP_MARGIN)
    lean = np.arccos(np.clip(-drops[:, 2, 2], -1, 1))
    stretched = np.maximum(qpos[:, ELBOW] - STRETCHED, 0)
    cost = joint_distance(qpos, arm.qpos) + LEAN_WEIGHT * lean + STRETCH_WEIGHT * stretched
    return np.lexsort((cost, np.ceil(overhang / 0.015)))


def _plan_to_first_drop(arm: Arm, drops: Array, qpos: Array) -> Trajectory:
    """Plan a motion to the first feasible drop pose.

    ``drops`` (N, 4, 4) are TCP poses, ``qpos`` (N, 7) the configurations at these poses.
    """
    start = arm.qpos
    chosen = np.flatnonzero(arm.planner.is_free(qpos[:DROPS_CHECKED], arm.planner.finger_width))[:DROPS_PLANNED]
    if not len(chosen):
        raise PlanningError("transfer", "no_free_drop")
    drops, qpos = drops[chosen], qpos[chosen]
    for drop, goal in zip(drops, qpos, strict=True):
        try:
            carry = arm.planner.plan_to_qpos(start, [goal], stage="transfer", straight_only=True)
            plan_retreat(arm, carry.qpos[-1], _retreat_poses(drop))  # a drop pose needs a retreat
            return carry
        except PlanningError:
            continue
    failure, left = PlanningError("transfer", "no_plan"), np.arange(len(drops))
    while len(left):
        carry = arm.planner.plan_to_qpos(start, list(qpos[left]), stage="transfer")
        reached = int(np.argmin(np.abs(qpos[left] - carry.qpos[-1]).max(axis=1)))
        try:
            plan_retreat(arm, carry.qpos[-1], _retreat_poses(drops[left[reached]]))
            return carry
        except PlanningError as error:
            failure, left = error, np.delete(left, reached)
    raise failure


def read_held_object(arm: Arm, slot: int) -> tuple[Array, Array]:
    """Read the geometry of a held object.

    Returns:
        Pose (4x4) of the object in the TCP frame; vertices (V, 3) of its convex hulls in the object's frame, m.
    """
    vertices = np.concatenate(arm.env.object_assets[0][slot].hulls)
    return inverse(arm.scene.tcp_in_base) @ arm.scene.object_in_base(slot), vertices


def attach_held_object(arm: Arm, slot: int) -> None:
    """Attach a held object to the TCP in the planner, and plan with the present width of the fingers."""
    object_in_tcp, vertices = read_held_object(arm, slot)
    arm.planner.attach(AttachedBody(vertices, object_in_tcp))
    arm.planner.finger_width = float(arm.env.agent.gripper_width[0])


def sample_drop_poses(arm: Arm, slot: int, arm_base_in_world: Array) -> Array:
    """Sample TCP poses (N, 4, 4), in the arm's base frame, with the held object above the basket.

    ``arm_base_in_world`` (4x4) is the pose of the arm's base, which may differ from the present pose.
    """
    object_in_tcp, vertices = read_held_object(arm, slot)
    center_of_mass = np.array([arm.env.object_assets[0][slot].asset.center_of_mass])
    return sample_poses_above_container(
        arm.rng,
        DROPS_SAMPLED,
        _basket_interior(arm, arm_base_in_world),
        transform_points(object_in_tcp, vertices),
        transform_points(object_in_tcp, center_of_mass)[0],
    )


def _basket_interior(arm: Arm, arm_base_in_world: Array) -> ContainerInterior:
    basket = arm.env.model.basket
    assert basket is not None  # required by the task
    inner = basket.asset.inner
    assert inner is not None  # checked by the scene model
    basket_in_base = inverse(arm_base_in_world) @ from_wxyz(arm.env.basket_pose[0])
    return ContainerInterior(basket_in_base, np.array(inner.min), np.array(inner.max))


def _retreat_poses(tcp_in_base: Array) -> list[Array]:
    back, up = shift_back(tcp_in_base, RETREAT_HEIGHT), RETREAT_HEIGHT
    return [shift_up(tcp_in_base, up), back, shift_up(back, up / 2), shift_up(tcp_in_base, up / 2)]


def _failure_reason(arm: Arm) -> str:
    for measure, reached in arm.env.success_conditions().items():
        if not bool(reached[0]):
            return f"not_{measure}"
    return "no_success"


def sample_poses_above_container(
    rng: np.random.Generator, count: int, inside: ContainerInterior, vertices: Array, center_of_mass: Array
) -> Array:
    """Sample TCP poses (count, 4, 4) with a held object above the rim of a container.

    Poses are in the arm's base frame.

    The approach axis is tilted away from the arm, so that far containers are within reach; half of the samples are
    steep, for near containers.

    Args:
        rng: random generator.
        count: number of poses.
        inside: interior of the container.
        vertices: (V, 3) vertices of the object's hulls in the TCP frame, m.
        center_of_mass: (3,) centre of mass of the object in the TCP frame, m.
    """
    middle, half = (inside.low + inside.high) / 2, (inside.high - inside.low) / 2
    local = np.column_stack(
        [
            middle[:2] + rng.uniform(-MAX_OFFSET_FRACTION, MAX_OFFSET_FRACTION, (count, 2)) * half[:2],
            np.full(count, inside.high[2]),
        ]
    )
    above = local @ inside.container_in_base[:3, :3].T + inside.container_in_base[:3, 3]
    tilt = np.deg2rad(MAX_TILT_DEG) * rng.uniform(0, 1, count) ** 2
    outward = np.arctan2(above[:, 1], above[:, 0]) + rng.uniform(-0.6, 0.6, count)
    roll = rng.uniform(-np.pi, np.pi, count)
    # straight down (z of the TCP = -z of the base) with a random roll, then tilted about the axis across ``outward``
    down = Rotation.from_euler("x", np.pi) * Rotation.from_euler("z", roll[:, None])
    across = np.column_stack([-np.sin(outward), np.cos(outward), np.zeros(count)])
    rotation = Rotation.from_rotvec(-across * tilt[:, None]) * down
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotation.as_matrix()
    lowest = (poses[:, 2, :3] @ vertices.T).min(axis=1)
    center = np.einsum("nij,j->ni", poses[:, :3, :3], center_of_mass)
    poses[:, :2, 3] = above[:, :2] - center[:, :2]
    poses[:, 2, 3] = above[:, 2] + rng.uniform(*RIM_CLEARANCE, count) - lowest
    return poses


def compute_overhang(tcp_in_base: Array, inside: ContainerInterior, vertices: Array, margin: float = 0.0) -> Array:
    """Compute how far a held object extends sideways beyond the opening of a container, m.

    Args:
        tcp_in_base: (n, 4, 4) TCP poses in the arm's base frame.
        inside: interior of the container.
        vertices: (V, 3) vertices of the object's hulls in the TCP frame, m.
        margin: reduction of the opening on each side, m.

    Returns:
        Overhang (n,), m; 0 where the object fits through the opening.
    """
    rotation, origin = inside.container_in_base[:3, :3], inside.container_in_base[:3, 3]
    points = np.einsum("nij,vj->nvi", tcp_in_base[:, :3, :3], vertices) + tcp_in_base[:, None, :3, 3]
    local = (points - origin) @ rotation
    return np.maximum(
        np.maximum(inside.low + margin - local, local - inside.high + margin)[..., :2].max(axis=(1, 2)), 0
    )
