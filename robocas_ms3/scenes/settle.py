"""Let objects come to rest where they were put, in a bare PhysX scene of their own, and see whether they stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True)
class SettleResult:
    """What became of objects that were put somewhere. K objects.

    Attributes:
        poses: (K, 4, 4) in the world, settled.
        moved: (K,) m, how far each moved while settling.
        tilted: (K,) rad, how far its vertical turned meanwhile.
        as_put: (K,) whether it settled about where it was put.
        shift: (K,) m, how far each moves within ``CHECK_SECONDS`` when it is put where it settled.
        turn: (K,) rad, how far it turns then.
        at_rest: (K,) whether it is at rest then, half-way and at the end.
    """

    poses: Array
    moved: Array
    tilted: Array
    as_put: np.ndarray
    shift: Array
    turn: Array
    at_rest: np.ndarray

    @property
    def stable(self) -> bool:
        """Whether all objects stay where they are, which is about where they were put."""
        still = (self.shift <= MAX_SHIFT) & (self.turn <= np.deg2rad(MAX_TURN_DEG)) & self.at_rest
        return bool((self.as_put & still).all())


def settle(
    assets: Sequence[LoadedObject], poses: Array, model: SceneModel, basket_pose: Array | None, *, heap: bool = False
) -> SettleResult:
    """Simulate objects among furniture and basket: first so that they settle, then to see whether they stay.

    The second part begins in a new scene, as a reset does: an engine that knows no contacts yet may give a narrow
    object a kick that it would not get where it has long been standing. Where objects move then, they have settled a
    little more, and are put into another new scene; a heap creeps for a while.

    Which contact the engine solves first depends on the order in which bodies were made, and on all else that is in a
    scene. So a heap has to stay with its objects made in either order.

    Args:
        assets: K objects.
        poses: (K, 4, 4) in the world.
        model: where the furniture stands; doors and drawers stay as at first.
        basket_pose: 4x4 in the world; None where there is no basket.
        heap: whether objects lie on each other; then they may tip over meanwhile.
    """
    with engine_settings():
        settled = _simulate(assets, poses, model, basket_pose, SETTLE_SECONDS)[0]
        for _ in range(CHECKS):
            max_tilt = np.inf if heap else np.deg2rad(MAX_TILT_DEG)
            for backwards in (False, True) if heap else (False,):
                after, speed, spin = _simulate(assets, settled, model, basket_pose, CHECK_SECONDS, backwards=backwards)
                at_rest = (speed <= MAX_LINEAR) & (spin <= MAX_ANGULAR)
                found = _compare(poses, settled, after, at_rest, max_tilt)
                if not found.stable:
                    break
            if found.stable or not found.as_put.all():
                break
            settled = after
    return found


def _compare(poses: Array, settled: Array, after: Array, at_rest: np.ndarray, max_tilt: float) -> SettleResult:
    moved = np.linalg.norm(settled[:, :3, 3] - poses[:, :3, 3], axis=1)
    upright = np.einsum("ki,ki->k", poses[:, 2, :3], settled[:, 2, :3])
    tilted = np.arccos(np.clip(upright, -1, 1))
    cosine = (np.einsum("kij,kij->k", settled[:, :3, :3], after[:, :3, :3]) - 1) / 2
    return SettleResult(
        poses=settled,
        moved=moved,
        tilted=tilted,
        as_put=(moved <= MAX_MOVE) & (tilted <= max_tilt),
        shift=np.linalg.norm(after[:, :3, 3] - settled[:, :3, 3], axis=1),
        turn=np.arccos(np.clip(cosine, -1, 1)),
        at_rest=at_rest,
    )


def _simulate(
    assets: Sequence[LoadedObject],
    poses: Array,
    model: SceneModel,
    basket_pose: Array | None,
    seconds: float,
    *,
    backwards: bool = False,
) -> tuple[Array, Array, Array]:
    """Simulate objects in a new scene; ``backwards``: the last one is made first.

    Returns:
        Poses (K, 4, 4) at the end; the greater of the speeds half-way and then, (K,) m/s and (K,) rad/s.
    """
    scene = new_scene()
    add_furniture(scene, model)
    if model.basket is not None and basket_pose is not None:
        add_fixed(scene, model.basket.hulls, basket_pose, model.basket.asset.friction)
    order = -1 if backwards else 1
    placed = list(zip(assets, poses, strict=True))[::order]
    bodies = [add_body(scene, solid_of(asset), pose) for asset, pose in placed][::order]
    speed, spin = np.zeros((2, len(bodies)))
    for _ in range(2):
        for _ in range(round(seconds / TIME_STEP / 2)):
            scene.step()
        speed = np.maximum(speed, [np.linalg.norm(body.linear_velocity) for body in bodies])
        spin = np.maximum(spin, [np.linalg.norm(body.angular_velocity) for body in bodies])
    return np.stack([pose_matrix(body) for body in bodies]), speed, spin


def add_furniture(scene: sapien.Scene, model: SceneModel) -> None:
    """Add the furniture where it stands, doors and drawers as at first; none of it moves."""
    for name, asset in model.furniture.items():
        frame = model.furniture_poses[name]
        add_fixed(scene, asset.hulls, frame, asset.asset.friction)
        for link, motion in link_poses(asset.asset.links, model.joint_positions(name, opened=False)).items():
            add_fixed(scene, asset.links[link].hulls, frame @ motion, asset.asset.friction)
