"""Check a configuration for overlaps and for things out of the robot's reach. No simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product

import numpy as np

from robocas_ms3.assets.hulls import Hull
from robocas_ms3.assets.kinematics import link_poses
from robocas_ms3.assets.pack import LoadedFurniture
from robocas_ms3.core.errors import ConfigError
from robocas_ms3.core.poses import transform_points
from robocas_ms3.robots.description import Envelope, RobotDescription
from robocas_ms3.scenes.config.task import TaskConfig
from robocas_ms3.scenes.placement import Array, Region

_TOUCHING = 0.005  # m by which hulls may overlap: collision hulls are coarser than the visual meshes
_STEP, _ALONG = 0.05, 0.01  # m between sampled positions of the base, and between sampled points of the arm


@dataclass(frozen=True)
class CollisionBody:
    """Furniture, basket, room or robot: key in the configuration, and convex hulls in the world frame, m."""

    key: str
    hulls: list[Hull]

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Least and greatest corner of the bounding box of each of the N hulls: two arrays (N, 3), m."""
        corners = [(hull.vertices.min(axis=0), hull.vertices.max(axis=0)) for hull in self.hulls]
        return np.array([low for low, _ in corners]), np.array([high for _, high in corners])


def check_clearance(
    config: TaskConfig,
    placed: Mapping[str, tuple[LoadedFurniture, Array]],
    region: tuple[Region, Array],
    robot_pose: Array,
    robot: RobotDescription,
) -> None:
    """Check that furniture, basket and robot do not overlap, and that the arm reaches basket and objects.

    A randomised pose of robot or basket is not checked for overlaps here, but when it is drawn (`robot_placement`). The
    reach is increased by the range of randomisation.

    Args:
        config: the task configuration.
        placed: asset and pose (4, 4) in the world by key: ``furniture.NAME``, ``room``, and optionally ``basket``.
        region: region of the objects, and the pose (4, 4) of its frame in the world while the furniture is open.
        robot_pose: (4, 4) pose of the robot's root in the world.
        robot: description of the robot. Without an envelope, body and reach of the robot are not checked.

    Raises:
        ConfigError: two bodies overlap, or something is out of reach; the message has the distance.
    """
    joints = {f"furniture.{name}": item.joints for name, item in config.furniture.items()}
    around = {key: CollisionBody(key, _world_hulls(*at, joints.get(key, {}))) for key, at in placed.items()}
    room, basket = around.pop("room"), around.pop("basket", None)
    pairs = [*combinations(around.values(), 2), *((one, room) for one in around.values())]
    fixed = [*around.values(), room]
    if basket is not None and config.randomisation.basket is None:
        pairs += [(basket, other) for other in fixed]
        fixed.append(basket)
    envelope = robot.envelope
    if envelope is not None and config.randomisation.robot is None:
        pairs += [(_robot_body(envelope, robot_pose), other) for other in fixed]
    for one, other in pairs:
        deep = max((overlap_depth(a, b) for a, b in _near_hulls(one, other)), default=0.0)
        if deep > _TOUCHING:
            fix = f"Move one of them by more than {deep:.2f} m" + ("." if other is room else ", or leave one out.")
            what, found = f"{one.key} and {other.key} overlap", f"an overlap of {deep:.3f} m"
            raise ConfigError(what, expected="no overlap", found=found, fix=fix)
    if envelope is not None:
        if config.randomisation.robot is None:
            arm = np.array(envelope.arm_at_start[config.robot_start])
            _check_arm(transform_points(robot_pose, _interpolate(arm)), fixed)
        _check_reach(
            config, placed.get("basket"), region, _shoulder_positions(config, robot_pose, robot, envelope), envelope
        )


def overlap_depth(one: Hull, other: Hull) -> float:
    """Return the least translation in m that separates two convex hulls; 0 if they do not overlap.

    The result is exact (separating axis theorem).
    """
    least = _least_overlap(one, other, np.concatenate([_normals(one), _normals(other)]))
    if least > 0:
        crossed = np.cross(_edges(one)[:, None], _edges(other)[None]).reshape(-1, 3)
        lengths = np.linalg.norm(crossed, axis=1)
        slanted = crossed[lengths > 1e-6] / lengths[lengths > 1e-6, None]
        if len(slanted):
            least = min(least, _least_overlap(one, other, slanted))
    return max(least, 0.0)


def _least_overlap(one: Hull, other: Hull, axes: Array) -> float:
    a, b = one.vertices @ axes.T, other.vertices @ axes.T
    return float(np.minimum(a.max(axis=0) - b.min(axis=0), b.max(axis=0) - a.min(axis=0)).min())


def _normals(hull: Hull) -> Array:
    a, b, c = (hull.vertices[hull.faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    return normals[lengths > 0] / lengths[lengths > 0, None]


def _edges(hull: Hull) -> Array:
    """Return the directions (E, 3) of the edges of a hull, without duplicates."""
    pairs = np.sort(np.concatenate([hull.faces[:, [0, 1]], hull.faces[:, [1, 2]], hull.faces[:, [2, 0]]]), axis=1)
    ways = np.diff(hull.vertices[np.unique(pairs, axis=0)], axis=1)[:, 0]
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    ways *= np.where(np.take_along_axis(ways, np.abs(ways).argmax(axis=1)[:, None], axis=1) < 0, -1.0, 1.0)
    return np.unique(ways.round(6), axis=0)


def _near_hulls(one: CollisionBody, other: CollisionBody) -> list[tuple[Hull, Hull]]:
    (low, high), (other_low, other_high) = one.bounds, other.bounds
    gap = np.minimum(high[:, None] - other_low[None], other_high[None] - low[:, None]).min(axis=2)
    return [(one.hulls[i], other.hulls[j]) for i, j in np.argwhere(gap > _TOUCHING)]


def _world_hulls(part: LoadedFurniture, pose: Array, joints: Mapping[str, float]) -> list[Hull]:
    hulls = [Hull(transform_points(pose, hull.vertices), hull.faces) for hull in part.hull_meshes]
    for name, moved in link_poses(part.asset.links, joints).items():
        hulls += [
            Hull(transform_points(pose @ moved, hull.vertices), hull.faces) for hull in part.links[name].hull_meshes
        ]
    return hulls


def _robot_body(envelope: Envelope, robot_pose: Array) -> CollisionBody:
    corners = np.array(list(product((-1.0, 1.0), (-1.0, 1.0), (0.0, 1.0))))
    sides = np.array([(0, 1, 2), (0, 1, 4), (0, 2, 4)])  # one face per axis: opposite faces add no separating axes
    hulls = [Hull(transform_points(robot_pose, corners * box), sides) for box in envelope.body_boxes]
    return CollisionBody("robot", hulls)


def _interpolate(corners: Array) -> Array:
    pieces = zip(corners[:-1], corners[1:], strict=True)
    return np.concatenate([np.linspace(a, b, int(np.ceil(np.linalg.norm(b - a) / _ALONG)) + 1) for a, b in pieces])


def _check_arm(points: Array, others: list[CollisionBody]) -> None:
    """Check that no point (P, 3) of the arm in its start pose is inside of another body."""
    for other in others:
        for hull, low, high in zip(other.hulls, *other.bounds, strict=True):
            close = points[np.all((points > low) & (points < high), axis=1)]
            if not len(close):
                continue
            normals = _normals(hull)
            along, spans = close @ normals.T, hull.vertices @ normals.T
            if ((along > spans.min(axis=0)) & (along < spans.max(axis=0))).all(axis=1).any():
                fix = f"Move or turn the robot or {other.key}, or choose another robot_start."
                what = "the start pose of the arm is inside of another body"
                raise ConfigError(what, where="robot", found=other.key, fix=fix)


def _shoulder_positions(config: TaskConfig, robot_pose: Array, robot: RobotDescription, envelope: Envelope) -> Array:
    """Return the possible positions (P, 3) of the arm's shoulder in the world, m.

    If the base may drive, the positions are a grid over the limits of the base; otherwise there is one position.
    """
    ranges = robot.base_limits[:2] if config.base_motion else ((0.0, 0.0),) * 2
    spans = [np.arange(low, high + _STEP, _STEP) for low, high in ranges]
    x, y = (grid.ravel() for grid in np.meshgrid(*spans))
    height = np.full(len(x), robot.arm_base_height + envelope.shoulder)
    return transform_points(robot_pose, np.stack([x, y, height], axis=1))


def _check_reach(
    config: TaskConfig,
    basket: tuple[LoadedFurniture, Array] | None,
    region: tuple[Region, Array],
    shoulders: Array,
    envelope: Envelope,
) -> None:
    """Check that region and basket are each within reach of at least one position of the shoulder.

    Args:
        config: the task configuration.
        basket: asset and pose (4, 4) of the basket; None: no basket.
        region: region of the objects, and the pose (4, 4) of its frame.
        shoulders: (P, 3) possible positions of the shoulder in the world, m.
        envelope: envelope of the robot.
    """
    moved = config.randomisation.robot
    reach = envelope.reach + _STEP + (np.sqrt(2) * moved.position if moved else 0.0)
    area, frame = region
    low, high = np.array([*area.min_xy, area.z]), np.array([*area.max_xy, area.z])
    fix = "Move it or the robot" if config.base_motion else "Move it or the robot, or set base_motion"
    _check_distance(_distance_to_box(shoulders, frame, low, high), reach, f"surface {config.surface.name!r}", fix)
    if basket is not None:
        by = config.randomisation.basket
        corners = np.concatenate(basket[0].hulls)
        far = _distance_to_box(shoulders, basket[1], corners.min(axis=0), corners.max(axis=0))
        _check_distance(far, reach + (np.sqrt(2) * by.position if by else 0.0), "the basket", fix)


def _check_distance(distance: float, limit: float, what: str, fix: str) -> None:
    if distance > limit:
        raise ConfigError(
            f"{what} is out of the arm's reach",
            expected=f"at most {limit:.2f} m from its shoulder",
            found=f"{distance:.2f} m",
            fix=f"{fix}: it is {distance - limit:.2f} m too far away.",
        )


def _distance_to_box(points: Array, frame: Array, low: Array, high: Array) -> float:
    """Return the least distance in m between points (P, 3) in the world and a box.

    Args:
        points: (P, 3) in the world, m.
        frame: (4, 4) pose of the box's frame in the world.
        low, high: (3,) corners of the box in its frame, m.
    """
    local = transform_points(np.asarray(np.linalg.inv(frame), dtype=np.float64), points)
    return float(np.linalg.norm(local - np.clip(local, low, high), axis=1).min())
