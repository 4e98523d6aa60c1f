"""Build bodies in a PhysX scene with the physics settings of the environments."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import sapien
from sapien import physx

from robocas_ms3.assets.hulls import Box, find_box
from robocas_ms3.assets.pack import BodyFiles, LoadedObject
from robocas_ms3.core.errors import AssetError

Array = np.ndarray

TIME_STEP = 0.01  # s, as in the environments
# m, as in the environments. PhysX computes contacts for shapes closer than twice this distance. ManiSkill's 0.02 gives
# three times more contact pairs in a heap, without more stable heaps or grasps.
CONTACT_OFFSET = 0.005
DAMPING = 0.1  # 1/s, linear and angular, of every free body, as in RoboCAS-v0
TABLE_FRICTION = 0.99
SPACING = 10.0  # m between objects that are simulated together


@dataclass(frozen=True)
class RigidBody:
    """A free rigid body.

    Attributes:
        hulls: vertices (V, 3) of each convex hull, m, body frame.
        mass: kg.
        center_of_mass: (3,) m, body frame.
        inertia: (3,) principal moments, kg m2.
        inertia_wxyz: (4,) orientation of the principal axes, body frame.
        friction: static and dynamic friction coefficient.
    """

    hulls: Sequence[Array]
    mass: float
    center_of_mass: Array
    inertia: Array
    inertia_wxyz: Array
    friction: float = 0.99


@contextmanager
def engine_settings() -> Iterator[None]:
    """Within a ``with`` block, give this process the physics settings of the environments."""
    scene, body, shape = physx.get_scene_config(), physx.get_body_config(), physx.get_shape_config()
    gravity: Any = np.array([0, 0, -9.81])  # the type in SAPIEN's stubs fits no NumPy array
    physx.set_scene_config(gravity=gravity)
    physx.set_body_config(solver_position_iterations=15, solver_velocity_iterations=1, sleep_threshold=0.005)
    physx.set_shape_config(contact_offset=CONTACT_OFFSET, rest_offset=0.0)
    try:
        yield
    finally:
        physx.set_scene_config(scene)
        physx.set_body_config(body)
        physx.set_shape_config(shape)


def make_scene(time_step: float = TIME_STEP) -> sapien.Scene:
    """Create an empty scene without a renderer, within a ``with engine_settings()`` block."""
    scene = sapien.Scene([physx.PhysxCpuSystem()])
    scene.set_timestep(time_step)
    return scene


def add_body(scene: sapien.Scene, rigid_body: RigidBody, pose: Array) -> physx.PhysxRigidDynamicComponent:
    """Add a free body to a scene; ``pose`` (4, 4) is the pose of the body frame in the world."""
    material = physx.PhysxMaterial(rigid_body.friction, rigid_body.friction, 0.0)
    free = physx.PhysxRigidDynamicComponent()
    try:
        for piece in rigid_body.hulls:
            free.attach(make_shape(piece, material))
    except RuntimeError as error:
        fix = "Import the asset again."
        raise AssetError("the physics engine rejected a convex hull", found=error, fix=fix) from error
    free.mass = rigid_body.mass
    free.cmass_local_pose = sapien.Pose(rigid_body.center_of_mass, rigid_body.inertia_wxyz)
    free.set_inertia(np.asarray(rigid_body.inertia, np.float64).tolist())
    free.linear_damping = free.angular_damping = DAMPING
    add_component(scene, free, sapien.Pose(pose))
    return free


def make_rigid_body(asset: LoadedObject) -> RigidBody:
    facts = asset.asset
    moments, center, axes = (np.array(v) for v in (facts.inertia, facts.center_of_mass, facts.inertia_wxyz))
    return RigidBody(asset.hulls, facts.mass, center, moments, axes, facts.friction)


def add_static_body(scene: sapien.Scene, hulls: Sequence[Array], pose: Array, friction: float) -> None:
    """Add a static body to a scene.

    Args:
        scene: the scene.
        hulls: vertices (V, 3) of each convex hull, m, body frame.
        pose: (4, 4) pose of the body frame in the world.
        friction: static and dynamic friction coefficient.
    """
    material = physx.PhysxMaterial(friction, friction, 0.0)
    body = physx.PhysxRigidStaticComponent()
    for piece in hulls:
        body.attach(make_shape(piece, material))
    add_component(scene, body, sapien.Pose(pose))


def add_ground(scene: sapien.Scene, origin: Array) -> None:
    """Add a static ground of 2 x 2 m to a scene.

    Args:
        scene: the scene.
        origin: (3,) centre of the upper side in the world, m.
    """
    material = physx.PhysxMaterial(TABLE_FRICTION, TABLE_FRICTION, 0.0)
    ground = physx.PhysxRigidStaticComponent()
    ground.attach(physx.PhysxCollisionShapeBox([1.0, 1.0, 0.05], material))
    add_component(scene, ground, sapien.Pose(origin - np.array([0, 0, 0.05])))


def grid_origins(count: int) -> Array:
    """Return positions (count, 3) in m for objects that are simulated together: a grid with four per row."""
    origins = np.zeros((count, 3))
    origins[:, 0], origins[:, 1] = np.arange(count) % 4 * SPACING, np.arange(count) // 4 * SPACING
    return origins


def make_shape(vertices: Array, material: physx.PhysxMaterial) -> physx.PhysxCollisionShape:
    """Create the collision shape of a convex hull with vertices (V, 3); a box shape if the hull is a box."""
    box = find_box(vertices)
    return make_convex_shape(vertices, material) if box is None else _box_shape(box, material)


def make_convex_shape(vertices: Array, material: physx.PhysxMaterial) -> physx.PhysxCollisionShapeConvexMesh:
    """Create PhysX's convex mesh of points (V, 3).

    It may be smaller than their convex hull (`cooked_hulls`).
    """
    return physx.PhysxCollisionShapeConvexMesh(
        vertices=np.asarray(vertices, np.float32), scale=[1, 1, 1], material=material
    )


def load_shapes(files: BodyFiles, material: physx.PhysxMaterial) -> list[physx.PhysxCollisionShape]:
    """Return the collision shape of each convex hull of a body. Bodies of one file share PhysX's meshes."""
    boxes = [find_box(hull) for hull in files.hulls]
    # boxes are not cooked: the engine rejects slender ones on a GPU
    loaded = [] if all(boxes) else _load_meshes(files.hulls_path, material)
    if loaded and len(loaded) != len(boxes):
        raise AssetError(
            "the physics engine rejected a convex hull",
            where=files.hulls_path,
            expected=f"{len(boxes)} hulls",
            found=len(loaded),
            fix="Import the asset again.",
        )
    return [_box_shape(box, material) if box is not None else loaded[i] for i, box in enumerate(boxes)]


def _load_meshes(path: Path, material: physx.PhysxMaterial) -> list[physx.PhysxCollisionShapeConvexMesh]:
    try:
        return physx.PhysxCollisionShapeConvexMesh.load_multiple(str(path), [1, 1, 1], material)
    except RuntimeError as error:
        fix = "Import the asset again."
        raise AssetError("the physics engine rejected a convex hull", where=path, found=error, fix=fix) from error


def _box_shape(box: Box, material: physx.PhysxMaterial) -> physx.PhysxCollisionShapeBox:
    shape = physx.PhysxCollisionShapeBox(box.half_size.tolist(), material)
    shape.local_pose = sapien.Pose(box.pose)
    return shape


def add_component(scene: sapien.Scene, component: physx.PhysxRigidBaseComponent, pose: sapien.Pose) -> None:
    entity = sapien.Entity()
    entity.add_component(component)
    entity.set_pose(pose)
    scene.add_entity(entity)


def pose_matrix(body: physx.PhysxRigidBaseComponent) -> Array:
    """Return the pose (4, 4) of a body in the world frame, float64."""
    return np.asarray(body.entity_pose.to_transformation_matrix(), float)
