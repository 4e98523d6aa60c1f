"""Build a configuration's room, furniture, basket, lights and objects into a ManiSkill scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Articulation, Pose
from mani_skill.utils.structs.render_camera import RenderCamera

from robocas_ms3.assets.pack import LoadedObject, VisualLevel
from robocas_ms3.assets.spawn import spawn, spawn_articulation
from robocas_ms3.scenes.config import TaskConfig
from robocas_ms3.scenes.layout import PARKING_HEIGHT
from robocas_ms3.scenes.model import SceneModel
from robocas_ms3.scenes.placement import Array
from robocas_ms3.scenes.randomise import draw_finishes, draw_lights

_SHADOW_NEAR = -2.0  # m along the light from the origin; with less, ceiling and walls shade the whole room


@dataclass(frozen=True)
class Fixtures:
    """Actors of room, furniture and basket, which all scenes of a configuration have in common."""

    room: Actor
    furniture: dict[str, Actor | Articulation]
    basket: Actor | None


def build_fixtures(
    scene: ManiSkillScene, model: SceneModel, level: VisualLevel = "fast", seeds: Sequence[int] = (0,)
) -> Fixtures:
    """Build room, furniture and basket in all sub-scenes.

    Args:
        scene: the ManiSkill scene.
        model: configuration and assets.
        level: level of detail of the visual meshes.
        seeds: seed of each sub-scene, from which the finishes of its room are drawn.
    """
    furniture: dict[str, Actor | Articulation] = {}
    for name, asset in model.furniture.items():
        build_one = spawn_articulation if asset.links else spawn
        furniture[name] = build_one(scene, asset, name=name, pose=sapien.Pose(model.furniture_poses[name]), level=level)
    room, basket = _build_room(scene, model, level, seeds), None
    if model.basket is not None and model.basket_pose is not None:
        basket = spawn(scene, model.basket, name="basket", pose=sapien.Pose(model.basket_pose), level=level)
    return Fixtures(room=room, furniture=furniture, basket=basket)


def _build_room(scene: ManiSkillScene, model: SceneModel, level: VisualLevel, seeds: Sequence[int]) -> Actor:
    finishes = [draw_finishes(model.config, model.room, seed) for seed in seeds]
    if all(other == finishes[0] for other in finishes):
        return spawn(scene, model.room, name="room", pose=sapien.Pose(), level=level, finishes=finishes[0])
    rooms = [
        spawn(scene, model.room, name=f"room-env_{i}", pose=sapien.Pose(), level=level, finishes=own, scene_idxs=[i])
        for i, own in enumerate(finishes)
    ]
    return Actor.merge(rooms, name="room")


def build_lights(scene: ManiSkillScene, config: TaskConfig, seeds: Sequence[int], *, shadow: bool) -> None:
    """Add lights to all sub-scenes.

    The seed of a sub-scene decides the intensity and direction of its lights.

    Args:
        scene: the ManiSkill scene.
        config: the task configuration.
        seeds: seed of each sub-scene.
        shadow: cast shadows also if ``lights.shadow`` of the configuration is false.
    """
    for i, seed in enumerate(seeds):
        lights = draw_lights(config, seed)
        scene.sub_scenes[i].ambient_light = [lights.ambient] * 3
        bright = [lights.directional] * 3
        scene.add_directional_light(
            lights.direction.tolist(),
            bright,
            shadow=shadow or config.lights.shadow,
            shadow_scale=5,
            shadow_near=_SHADOW_NEAR,
            shadow_map_size=2048,
            scene_idxs=[i],
        )
        scene.add_directional_light([0, 0, -1], bright, scene_idxs=[i])


def shift_cameras(cameras: Sequence[RenderCamera], shifts: Array) -> None:
    """Move and turn C cameras in N sub-scenes by motions (N, C, 4, 4) in the frames of the cameras."""
    for number, camera in enumerate(cameras):
        for part, shift in zip(camera._render_cameras, shifts[:, number], strict=True):
            part.local_pose = part.local_pose * sapien.Pose(shift)


def build_objects(
    scene: ManiSkillScene, config: TaskConfig, assets: Sequence[Sequence[LoadedObject]], level: VisualLevel
) -> list[Actor]:
    """Build the actor of each object slot, and the parking plane if slots may be unused.

    Args:
        scene: the ManiSkill scene.
        config: the task configuration.
        assets: objects of each env, one per slot.
        level: level of detail of the visual meshes.
    """
    columns = zip(*assets, strict=True)
    actors = [build_object_slot(scene, slot, column, level) for slot, column in enumerate(columns)]
    if config.has_unused_slots:
        build_parking_plane(scene, len(actors))
    return actors


def build_object_slot(
    scene: ManiSkillScene, slot: int, assets: Sequence[LoadedObject], level: VisualLevel = "fast"
) -> Actor:
    """Build the actor of one object slot, whose body in env i is ``assets[i]``."""
    name, waiting = f"object_{slot}", sapien.Pose([slot * 0.5, 0, 20.0])
    envs_of: dict[str, list[int]] = {}
    for env, asset in enumerate(assets):
        envs_of.setdefault(asset.asset.id, []).append(env)
    if len(envs_of) == 1:
        return spawn(scene, assets[0], name=name, pose=waiting, level=level)
    actors = [
        spawn(scene, assets[envs[0]], name=f"{name}-{asset_id}", pose=waiting, level=level, scene_idxs=envs)
        for asset_id, envs in envs_of.items()
    ]
    for actor in actors:
        scene.remove_from_state_dict_registry(actor)
    merged = Actor.merge(actors, name=name)
    order = merged._scene_idxs.argsort()
    merged._objs, merged._bodies = ([found[i] for i in order.tolist()] for found in (merged._objs, merged._bodies))
    merged._scene_idxs = merged._scene_idxs[order]
    merged.initial_pose = Pose.create(waiting, device=scene.device)
    scene.add_to_state_dict_registry(merged)
    return merged


def build_parking_plane(scene: ManiSkillScene, slots: int) -> Actor:
    """Build the plane far below the floor on which the objects of unused slots lie."""
    builder: Any = scene.create_actor_builder()
    half_size = [(slots + 1) / 2, 1.0, 0.1]
    center = sapien.Pose([(slots - 1) / 4, 0, PARKING_HEIGHT - half_size[2]])
    builder.add_box_collision(half_size=half_size)
    builder.initial_pose = center
    return builder.build_static("parking")
