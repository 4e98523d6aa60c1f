"""Build assets in a ManiSkill scene; without a renderer, bodies have no visual meshes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Articulation

from robocas_ms3.assets.kinematics import joint_frame
from robocas_ms3.assets.manifest import BODY, FurnitureAsset, Link, ObjectAsset
from robocas_ms3.assets.pack import BodyFiles, LoadedFurniture, LoadedObject, VisualLevel
from robocas_ms3.assets.physics import DAMPING, load_shapes
from robocas_ms3.core.errors import AssetError


def spawn(
    scene: ManiSkillScene,
    asset: LoadedObject | LoadedFurniture,
    *,
    name: str,
    pose: sapien.Pose,
    level: VisualLevel = "fast",
    finishes: Mapping[str, str] | None = None,
    scene_idxs: Sequence[int] | None = None,
) -> Actor:
    """Build an asset without moving parts as an actor.

    The actor is dynamic if the asset has a mass, otherwise static.

    Args:
        scene: the ManiSkill scene.
        asset: object, furniture, basket or room.
        name: unique name of the actor.
        pose: initial pose of the asset's frame in the world.
        level: level of detail of the visual mesh.
        finishes: part of a room -> finish; parts that are not listed have their default finish.
        scene_idxs: indices of the sub-scenes that get the actor; default: all.

    Raises:
        AssetError: the physics engine rejected a hull, or a finish is unknown.
    """
    builder: Any = scene.create_actor_builder()
    facts = asset.asset
    _add_shapes(builder, asset, facts.friction, level, render=scene.can_render())
    if scene.can_render() and isinstance(asset, LoadedFurniture):
        for part, known in asset.asset.finishes.items():
            builder.add_visual_from_file(str(asset.finish_path(part, (finishes or {}).get(part, known[0]))))
    builder.initial_pose = pose
    if scene_idxs is not None:
        builder.set_scene_idxs(list(scene_idxs))
    if facts.mass is None:
        return builder.build_static(name)
    _set_mass(builder, facts)
    actor = builder.build_dynamic(name)
    actor.set_linear_damping(DAMPING)
    actor.set_angular_damping(DAMPING)
    return actor


def spawn_articulation(
    scene: ManiSkillScene,
    asset: LoadedFurniture,
    *,
    name: str,
    pose: sapien.Pose,
    level: VisualLevel = "fast",
) -> Articulation:
    """Build furniture with moving parts as an articulation with a fixed root; all joints are at 0.

    Args:
        scene: the ManiSkill scene.
        asset: the furniture.
        name: unique name of the articulation.
        pose: pose of the furniture's frame in the world.
        level: level of detail of the visual meshes.
    """
    builder: Any = scene.create_articulation_builder()
    facts = asset.asset
    root = builder.create_link_builder()
    root.set_name(BODY)
    root.set_joint_name(BODY)
    root.set_joint_properties("fixed", [], sapien.Pose(), sapien.Pose())
    _add_shapes(root, asset, facts.friction, level, render=scene.can_render())
    made = {"": root}
    for link in facts.links:
        part = builder.create_link_builder(made[link.parent])
        part.set_name(link.name)
        part.set_joint_name(link.joint.name)
        # all link frames coincide with joints at 0, so the joint has the same pose in both
        frame = sapien.Pose(joint_frame(link.joint))
        part.set_joint_properties(link.joint.kind, [link.joint.limits], frame, frame, damping=link.joint.damping)
        _add_shapes(part, asset.links[link.name], facts.friction, level, render=scene.can_render())
        _set_mass(part, link)
        made[link.name] = part
    builder.initial_pose = pose
    articulation = builder.build(name)
    frictions = {link.joint.name: link.joint.friction for link in facts.links}
    for joint in articulation.active_joints:  # the builder ignores friction
        joint.set_friction(frictions[joint.name])
    return articulation


def _add_shapes(builder: Any, part: BodyFiles, friction: float, level: VisualLevel, *, render: bool) -> None:
    make = builder.build_physx_component

    def build(link_parent: Any = None) -> Any:
        # the builder itself would not detect boxes, and would skip hulls that cannot be cooked
        component = make(link_parent)
        for shape in load_shapes(part, sapien.physx.PhysxMaterial(friction, friction, 0.0)):
            component.attach(shape)
        return component

    builder.build_physx_component = build
    if render:
        builder.add_visual_from_file(str(part.visual_path(level)))


def _set_mass(builder: Any, facts: ObjectAsset | FurnitureAsset | Link) -> None:
    if facts.inertia is None:
        raise AssetError("an asset with a mass needs the key inertia", where=getattr(facts, "id", ""))
    frame = sapien.Pose(list(facts.center_of_mass), list(facts.inertia_wxyz))
    builder.set_mass_and_inertia(facts.mass, frame, np.array(facts.inertia))
