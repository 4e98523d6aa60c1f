"""Grasp an obstacle and place it at a free position on the surface."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, KDTree
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import PlanningError
from robocas_ms3.core.poses import transform_points
from robocas_ms3.planning.protocol import Array, Trajectory
from robocas_ms3.planning.shapes import convex_hull
from robocas_ms3.planning.skills.arm import (
    Arm,
    PlannedPrimitive,
    plan_first_feasible,
    plan_retreat,
    shift_back,
    shift_up,
)
from robocas_ms3.planning.skills.grasp import grasp, retract_from_contact
from robocas_ms3.planning.skills.place import attach_held_object
from robocas_ms3.planning.skills.push import read_surface
from robocas_ms3.scenes.grasp_checks import (
    HALF_TURN,
    MAX_WIDTH,
    NEIGHBOURHOOD,
    PREGRASP_DISTANCE,
    grasp_direction_tests,
    is_gripper_clear,
)

GRID = 0.04  # m between candidate positions
TURNS = 8  # yaw angles of the object
PLACEMENT_CLEARANCE = 0.03  # m to all other bodies, horizontally
EDGE_MARGINS = (0.1, 0.03)  # m to the edge of the surface; the first feasible one is used
RELEASE_HEIGHT = 0.012  # m from the object's lowest point to the surface at the release
PLACE_APPROACH_HEIGHT = 0.06  # m above that; the object moves straight down from there
RETREAT = 0.08  # m
ARM_REACH = 0.8  # m from its base
LIFT_RANGE = (0.08, 0.2)  # m, minimum and maximum lift
GRASPS_TESTED = 150  # grasps whose gripper is tested for collisions
GRASPS_SOLVED = 16  # grasps whose arm configuration is tested for collisions
OUTLINE_SPACING = 0.015  # m
PLACES_SOLVED, PLACES_PLANNED = 256, 12


def remove_object(arm: Arm, slot: int, *, grasps: Iterable[Array] = ()) -> None:
    """Grasp an object, place it at a free position on the surface, and retreat.

    Args:
        arm: context of the attempt.
        slot: slot of the object.
        grasps: TCP poses (4x4) of grasps to try, in the arm's base frame; empty: the annotated grasps.

    Raises:
        PlanningError: a motion cannot be planned, or the gripper loses the object.
    """
    grasp(arm, slot, lift_height=compute_lift_height(arm, slot), grasps=grasps)
    assert arm.planned is not None  # set by `grasp`
    start = arm.planned.start_in_base
    raise_held_object(arm, slot)
    with arm.planning_time():
        way = plan_placement(arm, slot)
        arm.planned = PlannedPrimitive("lift", slot, start, arm.planner.tcp(way.qpos[-1]))
    arm.follow(way)
    if not arm.is_holding(slot):
        raise PlanningError("remove", "dropped")
    arm.open_gripper()
    with arm.planning_time():
        arm.clear_attached()
        retreat = plan_retreat(arm, arm.qpos, _retreat_poses(arm.planner.tcp(arm.qpos)))
    arm.follow(retreat)


def raise_held_object(arm: Arm, slot: int) -> None:
    """Raise a held object in small steps until arm and object are collision-free."""
    attach_held_object(arm, slot)
    arm.rise_until_free(exclude=slot)


def compute_lift_height(arm: Arm, slot: int) -> float:
    """Return the lift height after which an object is above all bodies around it, m.

    The height is within ``LIFT_RANGE``.
    """
    points = transform_points(arm.scene.object_in_base(slot), np.concatenate(arm.env.object_assets[0][slot].hulls))
    middle = points.mean(axis=0)
    radius = float(np.linalg.norm((points - middle)[:, :2], axis=1).max())
    others = arm.scene.points_in_base(exclude=slot)
    near = others[np.linalg.norm((others - middle)[:, :2], axis=1) <= radius + PLACEMENT_CLEARANCE]
    return float(np.clip(near[:, 2].max(initial=0.0) + 0.02 - points[:, 2].min(), *LIFT_RANGE))


def count_clear_grasps(arm: Arm, slot: int) -> int:
    """Return the number of sampled grasps of an object whose gripper touches no other body."""
    grasps = sample_suitable_grasps(arm, slot)
    around = arm.scene.object_in_base(slot)[:3, 3]
    near = arm.scene.points_in_base(exclude=slot, radius=NEIGHBOURHOOD, around=around)
    return int(is_gripper_clear(grasps, near).sum())


def count_feasible_grasps(arm: Arm, slot: int) -> int:
    """Return the number of sampled grasps of an object that the arm reaches without touching other bodies.

    At most ``GRASPS_SOLVED`` clear grasps are tested.
    """
    grasps = sample_suitable_grasps(arm, slot)
    around = arm.scene.object_in_base(slot)[:3, 3]
    near = arm.scene.points_in_base(exclude=slot, radius=NEIGHBOURHOOD, around=around)
    grasps = grasps[is_gripper_clear(grasps, near)]
    grasps = grasps[np.linspace(0, len(grasps) - 1, min(len(grasps), GRASPS_SOLVED)).astype(int)]
    both = np.concatenate([grasps, grasps @ HALF_TURN])
    reachable, _ = arm.inverse_kinematics.nearest_solutions(shift_back(both, PREGRASP_DISTANCE), arm.qpos)
    return len(retract_from_contact(arm, slot, both[reachable]))


def find_grasp_blockers(arm: Arm, slot: int) -> list[int]:
    """Return slots of the objects that block grasps of an object from above.

    Objects that alone block many grasps come first; a grasp that n objects block counts 1 / n^2 for each of them.
    """
    blocked_by = _find_blocked_grasps(arm, slot)
    count = np.sum(list(blocked_by.values()), axis=0)
    score = {other: float(np.sum(blocked / np.maximum(count, 1) ** 2)) for other, blocked in blocked_by.items()}
    return sorted((other for other in score if score[other] > 0), key=lambda other: -score[other])


def count_fewest_blockers(arm: Arm, slot: int) -> int:
    """Return the smallest number of objects that block a grasp of an object from above.

    The result is the number of all other objects if no sampled grasp is narrow enough and has a suitable direction.
    """
    blocked_by = _find_blocked_grasps(arm, slot)
    return int(np.sum(list(blocked_by.values()), axis=0, initial=0).min(initial=len(blocked_by)))


def _find_blocked_grasps(arm: Arm, slot: int) -> dict[int, NDArray[np.bool_]]:
    """Return by slot of each other object which of the sampled grasps (G,) of an object it blocks."""
    grasps = sample_suitable_grasps(arm, slot)
    others = [other for other, used in enumerate(arm.env.present[0].tolist()) if used and other != slot]
    return {other: ~is_gripper_clear(grasps, arm.scene.object_points(other)) for other in others}


def sample_suitable_grasps(arm: Arm, slot: int) -> Array:
    """Return annotated grasps (G, 4, 4) of an object that are narrow enough and have a suitable direction.

    The poses are TCP poses in the arm's base frame; G is at most ``GRASPS_TESTED``.
    """
    notes, frame = arm.env.object_assets[0][slot].annotations, arm.scene.object_in_base(slot)
    grasps = frame @ notes.grasps_tcp_in_object
    passed = np.logical_and.reduce(list(grasp_direction_tests(grasps, frame[:3, 3], arm.approach).values()))
    grasps = grasps[passed & (notes.grasp_widths <= MAX_WIDTH)]
    # evenly spaced instead of drawn, so that this query does not change the random state
    return grasps[np.linspace(0, len(grasps) - 1, min(len(grasps), GRASPS_TESTED)).astype(int)]


def plan_placement(arm: Arm, slot: int) -> Trajectory:
    """Plan a motion that carries a held object to a free position on the surface and down to the surface.

    The object is placed in its nearest stable orientation, since objects in a heap are tilted and would fall over. If
    this is not feasible, the object is placed in the orientation in which it is held.
    """
    scene, asset, held = arm.scene, arm.env.object_assets[0][slot], arm.scene.object_in_base(slot)
    vertices = transform_points(held, np.concatenate(asset.hulls))
    standing = compute_upright_rotation(vertices, transform_points(held, np.array([asset.asset.center_of_mass]))[0])
    others = scene.points_in_base(exclude=slot)
    arm.planner.set_scene(scene.obstacles(exclude=slot))
    attach_held_object(arm, slot)

    def free_poses() -> Iterator[Array]:
        for turn, margin in itertools.product((standing, np.eye(4)), EDGE_MARGINS):
            motions = find_free_places(transform_points(turn, vertices), others, *read_surface(arm), margin) @ turn
            if len(motions):
                yield motions @ scene.tcp_in_base

    failure = PlanningError("remove", "no_free_position")
    return plan_first_feasible(free_poses(), lambda places: _plan_to_first_place(arm, places), failure)


def _plan_to_first_place(arm: Arm, places: Array) -> Trajectory:
    """Plan a motion to above the first feasible TCP pose of ``places`` (N, 4, 4) and down to this pose."""
    start = arm.qpos
    nearest = np.argsort(np.linalg.norm(places[:, :2, 3] - arm.scene.tcp_in_base[:2, 3], axis=1), kind="stable")
    # near and far poses; inverse kinematics of all poses would take seconds
    places = places[nearest[:: max(1, len(places) // PLACES_SOLVED)]]
    above = shift_up(places, PLACE_APPROACH_HEIGHT)
    solved, qpos = arm.inverse_kinematics.nearest_solutions(above, start)
    solved[solved] = arm.inverse_kinematics.nearest_solutions(places[solved], start)[0]
    places, above, qpos = places[solved], above[solved], qpos[solved]

    def plan(index: int) -> Trajectory:
        carry = arm.planner.plan_to_pose(start, above[index], stage="remove")
        down = arm.planner.plan_straight(carry.qpos[-1], places[index], stage="remove")
        return arm.planner.join(start, carry, down)

    order = np.argsort(np.abs(qpos - start).max(axis=1), kind="stable")[:PLACES_PLANNED]
    return plan_first_feasible(order, plan, PlanningError("remove", "unreachable"))


def compute_upright_rotation(vertices: Array, center_of_mass: Array) -> Array:
    """Return the smallest rotation (4x4) that turns a body to a stable orientation.

    Args:
        vertices: (V, 3) vertices of the body in a frame with z up, m.
        center_of_mass: (3,) centre of mass in this frame, m.
    """
    corners, faces, normals = convex_hull(vertices)
    a, b, c = corners[faces.T]
    # a face is stable if the centre of mass is above it
    above = [np.einsum("ij,ij->i", np.cross(q - p, center_of_mass - p), normals) for p, q in ((a, b), (b, c), (c, a))]
    stable = normals[np.all(np.array(above) >= -1e-9, axis=0)]
    down = stable[np.argmin(stable[:, 2])]
    axis = np.cross(down, (0, 0, -1))
    sine = np.linalg.norm(axis)
    turn = np.eye(4)
    if sine > 0:
        turn[:3, :3] = Rotation.from_rotvec(axis / sine * np.arctan2(sine, -down[2])).as_matrix()
    return turn


def find_free_places(
    vertices: Array, others: Array, frame: Array, half: Array, margin: float = EDGE_MARGINS[-1]
) -> Array:
    """Return transforms (n, 4, 4) that move a held object to free positions on a surface.

    Transforms are in the arm's base frame.

    Args:
        vertices: (V, 3) vertices of the held object in the arm's base frame, m.
        others: (P, 3) surface points of all other bodies, m.
        frame: (4x4) pose of the centre of the surface.
        half: (2,) half size of the surface, m.
        margin: minimum distance of the object to the edge of the surface, m.
    """
    middle = (vertices.max(axis=0) + vertices.min(axis=0)) / 2
    outline = (vertices - middle)[:, :2]
    limit = np.maximum(half - margin, 0)
    axes = [np.arange(-extent, extent + 1e-9, GRID) for extent in limit]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    spots = grid @ frame[:2, :2].T + frame[:2, 3]
    spots = spots[np.linalg.norm(spots, axis=1) <= ARM_REACH]
    standing = others[others[:, 2] > frame[2, 3] + 0.005]
    tree = KDTree(standing[:, :2])
    distance, _ = tree.query(spots)
    spots = spots[distance >= PLACEMENT_CLEARANCE]  # the centre of the position is free
    rise = frame[2, 3] + RELEASE_HEIGHT - vertices[:, 2].min()
    motions = []
    for turn in np.arange(TURNS) * 2 * np.pi / TURNS:
        rotation = Rotation.from_euler("z", turn).as_matrix()
        corners = spots[:, None] + _outline_points(outline @ rotation[:2, :2].T)  # (n, V, 2)
        local = (corners - frame[:2, 3]) @ frame[:2, :2]
        inside = np.all(np.abs(local) <= limit, axis=(1, 2))
        free = np.zeros(len(spots), dtype=bool)
        free[inside] = tree.query(corners[inside])[0].min(axis=1) >= PLACEMENT_CLEARANCE
        for spot in spots[free]:
            motion = np.eye(4)
            motion[:3, :3] = rotation
            motion[:3, 3] = np.append(spot, middle[2] + rise) - rotation @ middle
            motions.append(motion)
    return np.array(motions).reshape(-1, 4, 4)


def _outline_points(outline: Array) -> Array:
    """Return points (n, 2) along the convex hull of points (V, 2), and the origin as the first point."""
    corners = outline[ConvexHull(outline).vertices]
    points = [np.zeros((1, 2))]
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        points.append(
            a + np.linspace(0, 1, 1 + int(np.linalg.norm(b - a) / OUTLINE_SPACING), endpoint=False)[:, None] * (b - a)
        )
    return np.concatenate(points)


def _retreat_poses(tcp_in_base: Array) -> list[Array]:
    back = shift_back(tcp_in_base, RETREAT)
    return [shift_up(tcp_in_base, RETREAT), shift_up(back, RETREAT / 2), back, shift_up(tcp_in_base, RETREAT / 2)]
