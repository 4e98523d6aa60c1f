"""Build assets into a ManiSkill scene. Without a renderer, bodies are built without visuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor

from robocas_ms3.assets.pack import LoadedFurniture, LoadedObject
from robocas_ms3.errors import AssetError

# Upstream's: linear and angular damping of every free body
DAMPING = 0.1


def spawn(
    scene: ManiSkillScene,
    asset: LoadedObject | LoadedFurniture,
    *,
    name: str,
    pose: sapien.Pose,
    scene_idxs: Sequence[int] | None = None,
) -> Actor:
    """Build an asset as one actor: a free body if it has a mass, else a static one.

    Args:
        scene: the ManiSkill scene.
        asset: what to build.
        name: unique name of the actor.
        pose: initial pose of the asset's frame in the world.
        scene_idxs: sub-scenes to build it in; none: all.

    Raises:
        AssetError: the physics engine refused a hull.
    """
    builder: Any = scene.create_actor_builder()
    facts = asset.asset
    material = sapien.physx.PhysxMaterial(facts.friction, facts.friction, 0.0)
    builder.add_multiple_convex_collisions_from_file(str(asset.hulls_path), material=material)
    if scene.can_render():
        builder.add_visual_from_file(str(asset.visual_path))
    builder.initial_pose = pose
    if scene_idxs is not None:
        builder.set_scene_idxs(list(scene_idxs))
    if facts.mass is None:
        return builder.build_static(name)
    if facts.inertia is None:
        raise AssetError("a body with a mass needs its inertia too", where=facts.id)
    axes = getattr(facts, "inertia_wxyz", (1.0, 0.0, 0.0, 0.0))
    frame = sapien.Pose(list(facts.center_of_mass), list(axes))
    builder.set_mass_and_inertia(facts.mass, frame, np.array(facts.inertia))
    actor = builder.build_dynamic(name)
    # ManiSkill's builder drops shapes that can't be cooked without a word
    for body in actor._bodies:
        if len(body.collision_shapes) != len(asset.hulls):
            raise AssetError(
                "the physics engine refused a convex hull",
                where=asset.hulls_path,
                expected=f"{len(asset.hulls)} hulls",
                found=len(body.collision_shapes),
                fix="Import the asset again.",
            )
    actor.set_linear_damping(DAMPING)
    actor.set_angular_damping(DAMPING)
    return actor
