"""Let objects come to rest where they were put, in a bare PhysX scene of their own, and see whether they stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import sapien
from sapien import physx

from robocas_ms3.assets.kinematics import link_poses
from robocas_ms3.assets.pack import LoadedObject
from robocas_ms3.assets.physics import TIME_STEP, add_body, add_fixed, engine_settings, new_scene, pose_matrix, solid_of
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.placement import Array

SETTLE_SECONDS, CHECK_SECONDS = 1.0, 1.0
MAX_MOVE = 0.05  # m, while settling: what goes farther has fallen off, or rolled into something
MAX_SHIFT, MAX_TURN_DEG = 0.003, 2.0  # in CHECK_SECONDS, of an object that stays
MAX_LINEAR, MAX_ANGULAR = 0.02, 0.2  # m/s, rad/s, of an object at rest


@dataclass(frozen=True)
class Settled:
    """What became of objects that were put somewhere. K objects.

    Attributes:
        poses: (K, 4, 4) in the world, once settled.
        moved: (K,) m, how far each moved in all.
        shift: (K,) m, how far each moved in the last ``CHECK_SECONDS``.
        turn: (K,) rad, how far it turned.
        at_rest: (K,) whether it has stopped.
    """

    poses: Array
    moved: Array
    shift: Array
    turn: Array
    at_rest: np.ndarray

    @property
    def stable(self) -> bool:
        """Whether all objects stay where they are, which is about where they were put."""
        still = (
            (self.moved <= MAX_MOVE)
            & (self.shift <= MAX_SHIFT)
            & (self.turn <= np.deg2rad(MAX_TURN_DEG))
            & self.at_rest
        )
        return bool(still.all())


def settle(assets: Sequence[LoadedObject], poses: Array, model: SceneModel, basket_pose: Array) -> Settled:
    """Simulate objects among furniture and basket: first so that they settle, then to see whether they stay.

    Args:
        assets: K objects.
        poses: (K, 4, 4) in the world.
        model: where the furniture stands; doors and drawers stay as at first.
        basket_pose: 4x4 in the world.
    """
    with engine_settings():
        scene, bodies = _build(assets, poses, model, basket_pose)
        _run(scene, SETTLE_SECONDS)
        before = np.stack([pose_matrix(body) for body in bodies])
        # whether they stay is asked of a fresh scene, as an environment will put them into one
        scene, bodies = _build(assets, before, model, basket_pose)
        _run(scene, CHECK_SECONDS)
        after = np.stack([pose_matrix(body) for body in bodies])
        speed = np.array([np.linalg.norm(body.linear_velocity) for body in bodies])
        spin = np.array([np.linalg.norm(body.angular_velocity) for body in bodies])
    cosine = (np.einsum("kij,kij->k", before[:, :3, :3], after[:, :3, :3]) - 1) / 2
    return Settled(
        poses=before,
        moved=np.linalg.norm(before[:, :3, 3] - poses[:, :3, 3], axis=1),
        shift=np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1),
        turn=np.arccos(np.clip(cosine, -1, 1)),
        at_rest=(speed <= MAX_LINEAR) & (spin <= MAX_ANGULAR),
    )


def _build(
    assets: Sequence[LoadedObject], poses: Array, model: SceneModel, basket_pose: Array
) -> tuple[sapien.Scene, list[physx.PhysxRigidDynamicComponent]]:
    scene = new_scene()
    for name, asset in model.furniture.items():
        frame = model.furniture_poses[name]
        add_fixed(scene, asset.hulls, frame, asset.asset.friction)
        for link, motion in link_poses(asset.asset.links, model.joint_positions(name, opened=False)).items():
            add_fixed(scene, asset.links[link].hulls, frame @ motion, asset.asset.friction)
    add_fixed(scene, model.basket.hulls, basket_pose, model.basket.asset.friction)
    return scene, [add_body(scene, solid_of(asset), pose) for asset, pose in zip(assets, poses, strict=True)]


def _run(scene: sapien.Scene, seconds: float) -> None:
    for _ in range(round(seconds / TIME_STEP)):
        scene.step()
