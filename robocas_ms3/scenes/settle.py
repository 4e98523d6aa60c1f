"""Let objects come to rest in a PhysX scene, and check that the settled layout is stable."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sapien

from robocas_ms3.assets.kinematics import link_poses
from robocas_ms3.assets.pack import LoadedObject
from robocas_ms3.assets.physics import (
    TIME_STEP,
    add_body,
    add_static_body,
    engine_settings,
    make_rigid_body,
    make_scene,
    pose_matrix,
)
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.placement import Array

SETTLE_SECONDS, CHECK_SECONDS = 1.0, 1.0
CHECKS = 3  # greatest number of checks; after motion the next check starts from the new poses
MAX_MOVE, MAX_TILT_DEG = 0.05, 5.0  # m and deg while settling; more: the object fell, tipped over or rolled away
MAX_SHIFT, MAX_TURN_DEG = 0.003, 2.0  # m and deg in CHECK_SECONDS, of a stable object
MAX_LINEAR, MAX_ANGULAR = 0.01, 0.1  # m/s and rad/s, of an object at rest


def settle(
    assets: Sequence[LoadedObject], poses: Array, model: SceneModel, basket_pose: Array | None, *, heap: bool = False
) -> tuple[Array, bool]:
    """Let objects settle among furniture and basket, then check that the settled poses are stable.

    Each check builds a new scene, as a reset does. The reason: without contacts from an earlier step, PhysX may push a
    narrow object over. If objects move in a check, the next check starts from their new poses, since heaps creep for a
    while.

    PhysX solves contacts in the order in which bodies are created. So a heap is checked with its objects created in
    forward and in reverse order.

    Args:
        assets: K objects.
        poses: (K, 4, 4) poses in the world.
        model: configuration and furniture; doors and drawers keep their start positions.
        basket_pose: (4, 4) pose in the world; None if the scene has no basket.
        heap: whether objects may rest on each other and tip over while settling.

    Returns:
        (K, 4, 4) settled poses in the world. Whether all objects are stable and near their original poses.
    """
    max_tilt = np.inf if heap else np.deg2rad(MAX_TILT_DEG)
    with engine_settings():
        settled = _simulate(assets, poses, model, basket_pose, SETTLE_SECONDS)[0]
        for _ in range(CHECKS):
            moved = np.linalg.norm(settled[:, :3, 3] - poses[:, :3, 3], axis=1)
            upright = np.einsum("ki,ki->k", poses[:, 2, :3], settled[:, 2, :3])
            tilted = np.arccos(np.clip(upright, -1, 1))
            if not ((moved <= MAX_MOVE) & (tilted <= max_tilt)).all():
                return settled, False
            for reverse_order in (False, True) if heap else (False,):
                after, at_rest = _simulate(
                    assets, settled, model, basket_pose, CHECK_SECONDS, reverse_order=reverse_order
                )
                if not (at_rest and _has_not_moved(settled, after)):
                    break
            else:
                return settled, True
            settled = after
    return settled, False


def _has_not_moved(before: Array, after: Array) -> bool:
    shift = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    cosine = (np.einsum("kij,kij->k", before[:, :3, :3], after[:, :3, :3]) - 1) / 2
    turn = np.arccos(np.clip(cosine, -1, 1))
    return bool(((shift <= MAX_SHIFT) & (turn <= np.deg2rad(MAX_TURN_DEG))).all())


def _simulate(
    assets: Sequence[LoadedObject],
    poses: Array,
    model: SceneModel,
    basket_pose: Array | None,
    seconds: float,
    *,
    reverse_order: bool = False,
) -> tuple[Array, bool]:
    """Simulate K objects in a new scene for some seconds.

    Args:
        assets, poses, model, basket_pose: as in `settle`.
        seconds: simulated time.
        reverse_order: whether the objects are created in reverse order.

    Returns:
        Poses (K, 4, 4) at the end. Whether all objects are at rest at half of the time and at the end.
    """
    scene = make_scene()
    add_furniture(scene, model)
    if model.basket is not None and basket_pose is not None:
        add_static_body(scene, model.basket.hulls, basket_pose, model.basket.asset.friction)
    order = -1 if reverse_order else 1
    placed = list(zip(assets, poses, strict=True))[::order]
    bodies = [add_body(scene, make_rigid_body(asset), pose) for asset, pose in placed][::order]
    at_rest = True
    for _ in range(2):
        for _ in range(round(seconds / TIME_STEP / 2)):
            scene.step()
        for body in bodies:
            at_rest &= bool(np.linalg.norm(body.linear_velocity) <= MAX_LINEAR)
            at_rest &= bool(np.linalg.norm(body.angular_velocity) <= MAX_ANGULAR)
    return np.stack([pose_matrix(body) for body in bodies]), at_rest


def add_furniture(scene: sapien.Scene, model: SceneModel) -> None:
    """Add the furniture of a configuration to a scene as static bodies.

    Doors and drawers are at their start positions.
    """
    for name, asset in model.furniture.items():
        frame = model.furniture_poses[name]
        add_static_body(scene, asset.hulls, frame, asset.asset.friction)
        for link, motion in link_poses(asset.asset.links, model.joint_positions(name, opened=False)).items():
            add_static_body(scene, asset.links[link].hulls, frame @ motion, asset.asset.friction)
