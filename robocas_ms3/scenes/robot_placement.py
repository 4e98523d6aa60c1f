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
    """Return the robot's 4x4 root pose: as configured, or drawn until its body is clear of furniture."""
    by = model.config.randomisation.robot
    points = np.zeros((0, 3)) if by is None else model.furniture_points
    return _place("robot", model.robot_pose, by, rng, lambda pose: is_body_clear(pose, points))


def place_basket(model: SceneModel, robot_pose: Array, rng: np.random.Generator) -> Array | None:
    """Return the basket's 4x4 pose: as configured, or drawn until it is stable and clear of the robot.

    Returns:
        The pose; None if the scene has no basket.
    """
    if model.basket is None or model.basket_pose is None:
        return None
    points = model.basket.surface_points()

    def good(pose: Array) -> bool:
        return is_body_clear(robot_pose, transform_points(pose, points)) and is_basket_stable(model, pose)

    return _place("basket", model.basket_pose, model.config.randomisation.basket, rng, good)


def _place(
    name: str, pose: Array, by: PoseRandomisation | None, rng: np.random.Generator, good: Callable[[Array], bool]
) -> Array:
    if by is None:
        return pose
    for _ in range(_TRIES):
        moved = _moved(pose, by, rng)
        if good(moved):
            return moved
    raise LayoutError(
        f"no valid pose of the {name} near its configured pose",
        where=f"randomisation.{name}",
        found=f"{_TRIES} poses tried",
        fix=f"Lower randomisation.{name}.position, or move the {name} farther from furniture and edges.",
    )


def _moved(pose: Array, by: PoseRandomisation, rng: np.random.Generator) -> Array:
    """Shift a pose in x and y and turn it about its vertical axis."""
    shift, yaw = rng.uniform(-by.position, by.position, 2), np.deg2rad(rng.uniform(-by.yaw_deg, by.yaw_deg))
    moved = pose @ from_xyz_yaw(0, 0, 0, yaw)
    moved[:2, 3] += shift
    return moved


def is_body_clear(base_in_world: Array, cloud: Array) -> bool:
    """Return whether no point is inside the robot's body; points below the floor are ignored.

    Args:
        base_in_world: 4x4 frame on the floor with the heading of the mobile base (the robot's root for base joints 0).
        cloud: (P, 3) points in the world, m.
    """
    local = transform_points(np.asarray(np.linalg.inv(base_in_world), dtype=np.float64), cloud)
    x, y, z = np.abs(local[:, 0]), np.abs(local[:, 1]), local[:, 2]
    inside = [(x <= half_x) & (y <= half_y) & (z <= height) for half_x, half_y, height in _BODY_BOXES]
    return not ((z > 0) & np.logical_or.reduce(inside)).any()


def is_basket_stable(model: SceneModel, basket_pose: Array) -> bool:
    """Simulate (30 ms) whether the basket is stable at a 4x4 pose, with a load in each of its corners."""
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
            if not _stands(
                RigidBody(model.basket.hulls, mass, center, inertia, axes, facts.friction), model, basket_pose
            ):
                return False
    return True


def _stands(solid: RigidBody, model: SceneModel, pose: Array) -> bool:
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
