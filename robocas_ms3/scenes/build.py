"""Put a configuration's room, furniture, basket and objects into a ManiSkill scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Articulation

from robocas_ms3.assets.pack import LoadedFurniture, LoadedObject, Pack, VisualLevel
from robocas_ms3.assets.spawn import spawn, spawn_articulation
from robocas_ms3.config.task import FurnitureConfig, PoseConfig, SurfaceConfig, TaskConfig
from robocas_ms3.errors import ConfigError
from robocas_ms3.scenes.placement import Placeable, Region, planar_pose, transform


@dataclass(frozen=True)
class Fixtures:
    """What stays the same in all scenes of a configuration."""

    room: Actor
    furniture: dict[str, Actor | Articulation]
    basket: Actor


def fixture_pose(config: PoseConfig) -> np.ndarray:
    """4x4 of a pose in the configuration."""
    return planar_pose(*config.position, np.deg2rad(config.yaw_deg))


def furniture_pose(config: FurnitureConfig, furniture: LoadedFurniture) -> np.ndarray:
    """4x4 of a piece of furniture's frame: the configuration says where its lowest point stands."""
    pose = fixture_pose(config.pose)
    pose[2, 3] += furniture.asset.origin_height
    return pose


def fixture_points(config: TaskConfig, pack: Pack) -> np.ndarray:
    """Samples (P, 3) of the collision surfaces of furniture and basket where the configuration puts them, world, m."""
    pieces = []
    for name, item in config.furniture.items():
        asset = find_furniture(pack, item.asset, key=f"furniture.{name}.asset")
        pieces.append(transform(furniture_pose(item, asset), asset.all_surface_points()))
    basket = find_container(pack, config.basket)
    return np.concatenate([*pieces, transform(furniture_pose(config.basket, basket), basket.surface_points())])


def build_fixtures(
    scene: ManiSkillScene, config: TaskConfig, furniture_pack: Pack, level: VisualLevel = "fast"
) -> Fixtures:
    """Build room, furniture and basket into every sub-scene; joints of furniture are closed.

    Raises:
        ConfigError: an asset is unknown or can't play its part.
    """
    room = find_furniture(furniture_pack, config.room.asset, key="room.asset")
    for part, finish in config.room.finishes.items():
        known = room.asset.finishes.get(part, ())
        if finish not in known:
            expected = f"one of {list(known)}" if known else f"a part among {sorted(room.asset.finishes)}"
            raise ConfigError(f"room.finishes.{part}: no such finish", expected=expected, found=finish)
    actors: dict[str, Actor | Articulation] = {}
    for name, item in config.furniture.items():
        asset = find_furniture(furniture_pack, item.asset, key=f"furniture.{name}.asset")
        build_one = spawn_articulation if asset.links else spawn
        actors[name] = build_one(scene, asset, name=name, pose=sapien.Pose(furniture_pose(item, asset)), level=level)
    basket = find_container(furniture_pack, config.basket)
    return Fixtures(
        room=spawn(scene, room, name="room", pose=sapien.Pose(), level=level, finishes=config.room.finishes),
        furniture=actors,
        basket=spawn(
            scene, basket, name="basket", pose=sapien.Pose(furniture_pose(config.basket, basket)), level=level
        ),
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


def find_furniture(pack: Pack, asset_id: str, *, key: str) -> LoadedFurniture:
    """Look up a piece of furniture.

    Raises:
        ConfigError: the pack has no such furniture.
    """
    if asset_id not in pack.furniture:
        raise ConfigError(
            f"{key}: no such furniture in pack {pack.name!r}",
            expected=f"one of {sorted(pack.furniture)}",
            found=asset_id,
        )
    return pack.furniture[asset_id]


def find_container(pack: Pack, config: FurnitureConfig) -> LoadedFurniture:
    """Look up the basket.

    Raises:
        ConfigError: no such furniture, or it isn't a movable container.
    """
    basket = find_furniture(pack, config.asset, key="basket.asset")
    if basket.asset.inner is None or basket.asset.mass is None:
        raise ConfigError("basket.asset: this furniture is no movable container", found=config.asset)
    return basket


def find_objects(pack: Pack, config: TaskConfig) -> list[str]:
    """Ids of the configuration's objects; it may name them by the numbers they have in GraspNet-1Billion.

    Raises:
        ConfigError: an id is not in the pack, or the pack has no objects.
    """
    known = sorted(pack.objects)
    numbers = {
        loaded.asset.graspnet_id: i for i, loaded in pack.objects.items() if loaded.asset.graspnet_id is not None
    }
    wanted = known if config.objects.ids == "all" else config.objects.ids
    ids = [numbers.get(i, str(i)) if isinstance(i, int) else i for i in wanted]
    unknown = [i for i in ids if i not in pack.objects]
    if unknown:
        expected = f"one of {known}" + (f", or a GraspNet number of {sorted(numbers)}" if numbers else "")
        raise ConfigError(
            f"objects.ids: no such object in pack {pack.name!r}", expected=expected, found=", ".join(unknown)
        )
    if not ids:
        raise ConfigError(f"objects.ids: pack {pack.name!r} has no objects to choose from")
    return ids


def find_region(config: SurfaceConfig, furniture: LoadedFurniture) -> Region:
    """Rectangle that objects are placed on, in the furniture's frame.

    Raises:
        ConfigError: the furniture has no such surface, or the rectangle sticks out of it.
    """
    surfaces = furniture.asset.surfaces
    if config.name not in surfaces:
        raise ConfigError("surface.name: no such surface", expected=f"one of {sorted(surfaces)}", found=config.name)
    whole = surfaces[config.name]
    if config.min_xy is None or config.max_xy is None:
        return Region(whole.min_xy, whole.max_xy, whole.z)
    inside = all(
        low <= a and b <= high
        for low, a, b, high in zip(whole.min_xy, config.min_xy, config.max_xy, whole.max_xy, strict=True)
    )
    if not inside:
        raise ConfigError(
            f"surface: the rectangle lies outside surface {config.name!r} of {furniture.asset.id!r}",
            expected=f"within {whole.min_xy}..{whole.max_xy}",
            found=f"{config.min_xy}..{config.max_xy}",
        )
    return Region(config.min_xy, config.max_xy, whole.z)


def placeable(asset: LoadedObject) -> Placeable:
    """What a layout has to know of an object."""
    notes = asset.annotations
    return Placeable(
        asset.asset.id,
        notes.resting_poses,
        notes.resting_probabilities,
        [notes.footprint(i) for i in range(len(notes.resting_poses))],
    )
