"""Build assets into a ManiSkill scene. Without a renderer, bodies are built without visuals."""

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
    """Build an asset without moving parts as one actor: a free body if it has a mass, else a static one.

    Args:
        scene: the ManiSkill scene.
        asset: the asset.
        name: unique name of the actor.
        pose: initial pose of the asset's frame in the world.
        level: of detail of the visual mesh.
        finishes: part -> finish, of rooms; parts not named get their default.
        scene_idxs: sub-scenes to build it in; default: all.

    Raises:
        AssetError: the physics engine refused a hull, or there is no such finish.
    """
    builder: Any = scene.create_actor_builder()
    facts = asset.asset
    _add_shapes(builder, asset, facts.friction, level, render=scene.can_render())
    if scene.can_render() and isinstance(asset, LoadedFurniture):
        for part, known in asset.asset.finishes.items():
            builder.add_visual_from_file(str(asset.finish(part, (finishes or {}).get(part, known[0]))))
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
    """Build furniture with moving parts, its body fixed in the world, its joints at 0. Arguments as in `spawn`."""
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
        # all frames coincide with every joint at 0, so the joint is in the same place in both
        frame = sapien.Pose(joint_frame(link.joint))
        part.set_joint_properties(link.joint.kind, [link.joint.limits], frame, frame, damping=link.joint.damping)
        _add_shapes(part, asset.links[link.name], facts.friction, level, render=scene.can_render())
        _set_mass(part, link)
        made[link.name] = part
    builder.initial_pose = pose
    articulation = builder.build(name)
    frictions = {link.joint.name: link.joint.friction for link in facts.links}
    for joint in articulation.active_joints:  # the builder drops what it is told of friction
        joint.set_friction(frictions[joint.name])
    return articulation


def _add_shapes(builder: Any, part: BodyFiles, friction: float, level: VisualLevel, *, render: bool) -> None:
    make = builder.build_physx_component

    def build(link_parent: Any = None) -> Any:
        # not by the builder's own means: it makes no boxes of a file's hulls, and drops those that can't be cooked
        component = make(link_parent)
        for shape in load_shapes(part, sapien.physx.PhysxMaterial(friction, friction, 0.0)):
            component.attach(shape)
        return component

    builder.build_physx_component = build
    if render:
        builder.add_visual_from_file(str(part.visual(level)))


def _set_mass(builder: Any, facts: ObjectAsset | FurnitureAsset | Link) -> None:
    if facts.inertia is None:
        raise AssetError("a body with a mass needs its inertia too", where=getattr(facts, "id", ""))
    frame = sapien.Pose(list(facts.center_of_mass), list(facts.inertia_wxyz))
    builder.set_mass_and_inertia(facts.mass, frame, np.array(facts.inertia))
