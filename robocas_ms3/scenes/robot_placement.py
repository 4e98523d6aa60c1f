"""Draw the poses of robot and basket around their configured poses, and check that they are valid."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from robocas_ms3.assets.physics import (
    TIME_STEP,
    RigidBody,
    add_body,
    add_static_body,
    engine_settings,
    make_scene,
    pose_matrix,
)
from robocas_ms3.core.errors import LayoutError
from robocas_ms3.core.poses import from_xyz_yaw, transform_points
from robocas_ms3.robots.description import PANDA_ENVELOPE
from robocas_ms3.scenes.config.randomisation import PoseRandomisation
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.placement import Array
from robocas_ms3.scenes.settle import add_furniture

STAND_SECONDS = 1.0
MAX_SHIFT, MAX_TURN_DEG = 0.005, 2.0  # m and deg, greatest motion of a stable basket in STAND_SECONDS
LOAD = 0.5  # kg
_TRIES = 50
_BODY_BOXES = PANDA_ENVELOPE.body_boxes  # for every robot, so that a layout depends on configuration and seeds only


def place_robot(model: SceneModel, rng: np.random.Generator) -> Array:
    """Return the pose (4, 4) of the robot's root in the world.

    With ``randomisation.robot``, poses are drawn until the body of the robot is clear of furniture. Without it, the
    result is the configured pose.
    """
    limits = model.config.randomisation.robot
    points = np.zeros((0, 3)) if limits is None else model.furniture_points
    return _draw_valid_pose("robot", model.robot_pose, limits, rng, lambda pose: is_body_clear(pose, points))


def place_basket(model: SceneModel, robot_pose: Array, rng: np.random.Generator) -> Array | None:
    """Return the pose (4, 4) of the basket in the world; None if the scene has no basket.

    With ``randomisation.basket``, poses are drawn until the basket is stable and clear of the robot. Without it, the
    result is the configured pose.
    """
    if model.basket is None or model.basket_pose is None:
        return None
    points = model.basket.surface_points()

    def is_valid(pose: Array) -> bool:
        return is_body_clear(robot_pose, transform_points(pose, points)) and is_basket_stable(model, pose)

    return _draw_valid_pose("basket", model.basket_pose, model.config.randomisation.basket, rng, is_valid)


def _draw_valid_pose(
    name: str,
    pose: Array,
    limits: PoseRandomisation | None,
    rng: np.random.Generator,
    is_valid: Callable[[Array], bool],
) -> Array:
    if limits is None:
        return pose
    for _ in range(_TRIES):
        moved = _draw_pose_near(pose, limits, rng)
        if is_valid(moved):
            return moved
    raise LayoutError(
        f"no valid random pose of the {name}",
        where=f"randomisation.{name}",
        found=f"{_TRIES} poses that are not stable or not clear of other bodies",
        fix=f"Lower randomisation.{name}.position, or move the {name} farther from furniture and edges.",
    )


def _draw_pose_near(pose: Array, limits: PoseRandomisation, rng: np.random.Generator) -> Array:
    """Draw a pose (4, 4) with random shifts in x and y and a random yaw relative to ``pose``."""
    shift, yaw = (
        rng.uniform(-limits.position, limits.position, 2),
        np.deg2rad(rng.uniform(-limits.yaw_deg, limits.yaw_deg)),
    )
    moved = pose @ from_xyz_yaw(0, 0, 0, yaw)
    moved[:2, 3] += shift
    return moved


def is_body_clear(base_in_world: Array, cloud: Array) -> bool:
    """Return whether no point is inside the body of the Panda; points below the floor are ignored.

    The body of the Panda is used for every robot, so that a layout depends on configuration and seeds only.

    Args:
        base_in_world: (4, 4) pose of the mobile base: position on the floor, and heading. With all base joints at 0 it
            is the pose of the robot's root.
        cloud: (P, 3) points in the world, m.
    """
    local = transform_points(np.asarray(np.linalg.inv(base_in_world), dtype=np.float64), cloud)
    x, y, z = np.abs(local[:, 0]), np.abs(local[:, 1]), local[:, 2]
    inside = [(x <= half_x) & (y <= half_y) & (z <= height) for half_x, half_y, height in _BODY_BOXES]
    return not ((z > 0) & np.logical_or.reduce(inside)).any()


def is_basket_stable(model: SceneModel, basket_pose: Array) -> bool:
    """Return whether the basket stays at a pose (4, 4) in the world, with a load in any of its corners.

    This is simulated, which takes about 30 ms.
    """
    assert model.basket is not None
    facts = model.basket.asset
    assert facts.inner is not None
    assert facts.mass is not None
    mass, own_center = facts.mass + LOAD, np.array(facts.center_of_mass)
    inertia, axes = np.array(facts.inertia), np.array(facts.inertia_wxyz)
    with engine_settings():
        for corner in itertools.product(*zip(facts.inner.min[:2], facts.inner.max[:2], strict=True)):
            load = np.array([*corner, facts.inner.min[2]])
            center = (facts.mass * own_center + LOAD * load) / mass
            if not _is_stable(
                RigidBody(model.basket.hulls, mass, center, inertia, axes, facts.friction), model, basket_pose
            ):
                return False
    return True


def _is_stable(solid: RigidBody, model: SceneModel, pose: Array) -> bool:
    scene = make_scene()
    add_furniture(scene, model)
    add_static_body(scene, model.room.hulls, np.eye(4), model.room.asset.friction)
    body = add_body(scene, solid, pose)
    for _ in range(round(STAND_SECONDS / TIME_STEP)):
        scene.step()
    after = pose_matrix(body)
    cosine = (np.trace(pose[:3, :3].T @ after[:3, :3]) - 1) / 2
    turn = np.arccos(np.clip(cosine, -1, 1))
    return bool(np.linalg.norm(after[:3, 3] - pose[:3, 3]) <= MAX_SHIFT and turn <= np.deg2rad(MAX_TURN_DEG))
