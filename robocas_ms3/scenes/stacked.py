"""Heaps: objects dropped one by one between four walls, which are then taken away. Bare PhysX."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sapien
from numpy.typing import NDArray
from sapien import physx
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.pack import LoadedObject
from robocas_ms3.assets.physics import (
    TIME_STEP,
    add_body,
    add_component,
    add_ground,
    engine_settings,
    new_scene,
    pose_matrix,
    solid_of,
)
from robocas_ms3.errors import LayoutError
from robocas_ms3.scenes.placement import Array, Region, planar_pose, transform

SECONDS_EACH = 1.0  # of simulation before the next object falls (upstream's); less where everything lies still
SETTLE_SECONDS = 2.0  # after the walls are gone
ORDER_NOISE = 0.5  # of the logarithm of an object's size
BUCKET = 0.8  # of the region's sides: narrower buckets make higher heaps, which spread when the walls are gone
SPREAD = 0.05  # m that centres of mass may lie outside the region in the end
WALL = 0.05  # m, half its thickness
_LOOK_EVERY = 10  # steps between two looks at whether everything lies still
_TRIES = 40


def drop_heap(
    rng: np.random.Generator,
    assets: Sequence[LoadedObject],
    region: Region,
    *,
    headroom: float = np.inf,
    drop_height: float = 0.3,
    tumble_probability: float = 0.6,
) -> Array:
    """Drop objects into a frictionless bucket on a plane, then take the bucket away (upstream's way).

    Other than upstream's, the bucket is a little smaller than the region, and small objects rather fall first: this
    buries more of them (docs/layouts.md has figures).

    Args:
        rng: source of all randomness.
        assets: K objects.
        region: of a horizontal plane.
        headroom: that the heap has to stay below, m.
        drop_height: of the object's lowest point above the plane, or above what lies there, m.
        tumble_probability: of a random orientation; otherwise a resting pose at a random yaw.

    Returns:
        (K, 4, 4) objects at rest in the region's frame, in the order of ``assets``.

    Raises:
        LayoutError: heap after heap fell apart over the region's edges, or was too high.
    """
    for _ in range(_TRIES):
        poses = _drop(rng, assets, region, drop_height, tumble_probability)
        centers = np.stack(
            [transform(p, np.array([a.asset.center_of_mass]))[0] for a, p in zip(assets, poses, strict=True)]
        )
        inside = (centers[:, :2] >= np.array(region.min_xy) - SPREAD) & (
            centers[:, :2] <= np.array(region.max_xy) + SPREAD
        )
        top = max(transform(p, np.concatenate(a.hulls))[:, 2].max() for a, p in zip(assets, poses, strict=True))
        if inside.all() and top - region.z < headroom:
            return poses
    raise LayoutError(
        f"{len(assets)} objects make no heap here",
        where="layout",
        found=f"{_TRIES} heaps fell apart" + (f" or rose above {headroom:.3f} m" if np.isfinite(headroom) else ""),
        fix="Lower objects.count or enlarge the surface.",
    )


def _drop(
    rng: np.random.Generator, assets: Sequence[LoadedObject], region: Region, height: float, tumble: float
) -> Array:
    low, high = np.array(region.min_xy), np.array(region.max_xy)
    middle, half = (low + high) / 2, BUCKET * (high - low) / 2
    bodies: dict[int, physx.PhysxRigidDynamicComponent] = {}
    with engine_settings():
        scene = new_scene()
        add_ground(scene, np.array([*middle, region.z]))
        walls = _add_walls(scene, middle, half, region.z)
        for index in falling_order(rng, assets):
            asset = assets[index]
            pose = _falling_pose(rng, asset, tumble)
            points = transform(pose, np.concatenate(asset.hulls))
            room = np.maximum(half - np.abs(points[:, :2]).max(axis=0), 0)
            x, y = middle + rng.uniform(-1, 1, 2) * room
            top = max((_top(b, assets[i]) for i, b in bodies.items()), default=region.z)
            pose = planar_pose(x, y, top + height - points[:, 2].min(), 0) @ pose
            bodies[int(index)] = add_body(scene, solid_of(asset), pose)
            _run(scene, SECONDS_EACH, bodies)
        for wall in walls:
            wall.remove_from_scene()
        for body in bodies.values():
            body.wake_up()
        _run(scene, SETTLE_SECONDS, bodies)
        return np.stack([pose_matrix(bodies[i]) for i in range(len(assets))])


def falling_order(rng: np.random.Generator, assets: Sequence[LoadedObject]) -> NDArray[np.intp]:
    """Indices in the order of falling: small ones rather first, each one's size times a random factor."""
    sizes = np.array([np.prod(asset.asset.extents) for asset in assets])
    return np.argsort(np.log(sizes) + rng.normal(scale=ORDER_NOISE, size=len(assets)))


def _falling_pose(rng: np.random.Generator, asset: LoadedObject, tumble: float) -> Array:
    """4x4 about the object's own centre of mass."""
    notes = asset.annotations
    if rng.uniform() < tumble:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(rng.normal(size=4)).as_matrix()
        pose[:3, 3] = -pose[:3, :3] @ np.array(asset.asset.center_of_mass)
        return pose
    choice = int(rng.choice(len(notes.resting_probabilities), p=notes.resting_probabilities))
    return planar_pose(0, 0, 0, rng.uniform(-np.pi, np.pi)) @ notes.resting_poses[choice]


def _add_walls(scene: sapien.Scene, middle: Array, half: Array, z: float) -> list[sapien.Entity]:
    """Four frictionless walls around a rectangle."""
    slippery = physx.PhysxMaterial(0.0, 0.0, 0.0)
    walls = []
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1)):
        size = np.array([*half + 2 * WALL, 1.0])
        size[axis] = WALL
        center = np.array([*middle, z + 1.0])
        center[axis] += sign * (half[axis] + WALL)
        body = physx.PhysxRigidStaticComponent()
        body.attach(physx.PhysxCollisionShapeBox(size, slippery))
        add_component(scene, body, sapien.Pose(center))
        walls.append(body.entity)
    return walls


def _top(body: physx.PhysxRigidDynamicComponent, asset: LoadedObject) -> float:
    return float(transform(pose_matrix(body), np.concatenate(asset.hulls))[:, 2].max())


def _run(scene: sapien.Scene, seconds: float, bodies: dict[int, physx.PhysxRigidDynamicComponent]) -> None:
    """Simulate for a while, or until nothing moves."""
    steps = round(seconds / TIME_STEP)
    for step in range(steps):
        scene.step()
        if step >= 3 * _LOOK_EVERY and step % _LOOK_EVERY == 0:
            speeds = [
                np.linalg.norm(b.linear_velocity) + 0.05 * np.linalg.norm(b.angular_velocity) for b in bodies.values()
            ]
            if max(speeds) < 0.01:
                return
