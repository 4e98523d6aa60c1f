"""Put a configuration's room, furniture, basket and objects into a ManiSkill scene."""

from __future__ import annotations

from dataclasses import dataclass

import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Articulation

from robocas_ms3.assets.pack import LoadedObject, VisualLevel
from robocas_ms3.assets.spawn import spawn, spawn_articulation
from robocas_ms3.scenes.layout import PARKING_HEIGHT
from robocas_ms3.scenes.model import SceneModel


@dataclass(frozen=True)
class Fixtures:
    """What stays the same in all scenes of a configuration."""

    room: Actor
    furniture: dict[str, Actor | Articulation]
    basket: Actor


def build_fixtures(scene: ManiSkillScene, model: SceneModel, level: VisualLevel = "fast") -> Fixtures:
    """Build room, furniture and basket into every sub-scene; joints of furniture are closed."""
    furniture: dict[str, Actor | Articulation] = {}
    for name, asset in model.furniture.items():
        build_one = spawn_articulation if asset.links else spawn
        furniture[name] = build_one(scene, asset, name=name, pose=sapien.Pose(model.furniture_poses[name]), level=level)
    return Fixtures(
        room=spawn(
            scene, model.room, name="room", pose=sapien.Pose(), level=level, finishes=model.config.room.finishes
        ),
        furniture=furniture,
        basket=spawn(scene, model.basket, name="basket", pose=sapien.Pose(model.basket_pose), level=level),
    )


def build_object_slot(
    scene: ManiSkillScene, slot: int, assets: list[LoadedObject], level: VisualLevel = "fast"
) -> Actor:
    """Build one slot of objects: env i gets ``assets[i]``; the actors are merged into one batched view.

    Until the layout puts them in place they hang apart from each other, high above the room.
    """
    name = f"object_{slot}"
    waiting = sapien.Pose([slot * 0.5, 0, 20.0])
    actors = [
        spawn(
            scene,
            asset,
            name=f"{name}-env_{i}" if len(assets) > 1 else name,
            pose=waiting,
            level=level,
            scene_idxs=[i],
        )
        for i, asset in enumerate(assets)
    ]
    if len(actors) == 1:
        return actors[0]
    for actor in actors:
        scene.remove_from_state_dict_registry(actor)
    merged = Actor.merge(actors, name=name)
    scene.add_to_state_dict_registry(merged)
    return merged


def build_parking(scene: ManiSkillScene, slots: int) -> Actor:
    """Build the plane, far below the floor, on which slots wait that an episode does not use."""
    builder = scene.create_actor_builder()
    half_size = [(slots + 1) / 2, 1.0, 0.1]
    center = sapien.Pose([(slots - 1) / 4, 0, PARKING_HEIGHT - half_size[2]])
    builder.add_box_collision(half_size=half_size)
    builder.initial_pose = center
    return builder.build_static("parking")
