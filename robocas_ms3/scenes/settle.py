"""Let objects come to rest where they were put, in a bare PhysX scene, and check whether they stay."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sapien

from robocas_ms3.assets.kinematics import link_poses
from robocas_ms3.assets.pack import LoadedObject
from robocas_ms3.assets.physics import TIME_STEP, add_body, add_fixed, engine_settings, new_scene, pose_matrix, solid_of
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.placement import Array

SETTLE_SECONDS, CHECK_SECONDS = 1.0, 1.0
CHECKS = 3  # at most; what moved in one is checked again from where it came to
MAX_MOVE, MAX_TILT_DEG = 0.05, 5.0  # while settling: what goes farther has fallen, tipped over or rolled off
MAX_SHIFT, MAX_TURN_DEG = 0.003, 2.0  # in CHECK_SECONDS, of an object that stays
MAX_LINEAR, MAX_ANGULAR = 0.01, 0.1  # m/s, rad/s, of an object at rest


def settle(
    assets: Sequence[LoadedObject], poses: Array, model: SceneModel, basket_pose: Array | None, *, heap: bool = False
) -> tuple[Array, bool]:
    """Simulate objects among furniture and basket: first so that they settle, then to see whether they stay.

    The second part begins in a new scene, as a reset does: an engine that knows no contacts yet may give a narrow
    object a kick that it would not get where it has long been standing. Where objects move then, they have settled a
    little more, and are put into another new scene; a heap creeps for a while.

    The engine solves contacts in an order that depends on the order in which bodies were made. So a heap has to stay
    with its objects made in either order.

    Args:
        assets: K objects.
        poses: (K, 4, 4) in the world.
        model: where the furniture stands; doors and drawers stay as at first.
        basket_pose: 4x4 in the world; None where there is no basket.
        heap: whether objects lie on each other; then they may tip over meanwhile.

    Returns:
        (K, 4, 4) settled poses in the world; whether all objects stay there, which is about where they were put.
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
            for backwards in (False, True) if heap else (False,):
                after, at_rest = _simulate(assets, settled, model, basket_pose, CHECK_SECONDS, backwards=backwards)
                if not (at_rest and _stay(settled, after)):
                    break
            else:
                return settled, True
            settled = after
    return settled, False


def _stay(before: Array, after: Array) -> bool:
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
    backwards: bool = False,
) -> tuple[Array, bool]:
    """Simulate objects in a new scene, where the last one is made first if ``backwards``.

    Returns:
        Poses (K, 4, 4) at the end; whether all are at rest, half-way and then.
    """
    scene = new_scene()
    add_furniture(scene, model)
    if model.basket is not None and basket_pose is not None:
        add_fixed(scene, model.basket.hulls, basket_pose, model.basket.asset.friction)
    order = -1 if backwards else 1
    placed = list(zip(assets, poses, strict=True))[::order]
    bodies = [add_body(scene, solid_of(asset), pose) for asset, pose in placed][::order]
    at_rest = True
    for _ in range(2):
        for _ in range(round(seconds / TIME_STEP / 2)):
            scene.step()
        for body in bodies:
            at_rest &= bool(np.linalg.norm(body.linear_velocity) <= MAX_LINEAR)
            at_rest &= bool(np.linalg.norm(body.angular_velocity) <= MAX_ANGULAR)
    return np.stack([pose_matrix(body) for body in bodies]), at_rest


def add_furniture(scene: sapien.Scene, model: SceneModel) -> None:
    """Add the furniture where it stands, doors and drawers as at first; none of it moves."""
    for name, asset in model.furniture.items():
        frame = model.furniture_poses[name]
        add_fixed(scene, asset.hulls, frame, asset.asset.friction)
        for link, motion in link_poses(asset.asset.links, model.joint_positions(name, opened=False)).items():
            add_fixed(scene, asset.links[link].hulls, frame @ motion, asset.asset.friction)
