"""A configuration and the assets it names, looked up and checked. No simulator."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robocas_ms3.assets.kinematics import link_poses
from robocas_ms3.assets.manifest import Joint
from robocas_ms3.assets.pack import LoadedFurniture, LoadedObject, Pack, load_pack
from robocas_ms3.config.task import PlacedConfig, PoseConfig, SurfaceConfig, TaskConfig
from robocas_ms3.errors import ConfigError
from robocas_ms3.scenes.placement import Array, Placeable, Region, planar_pose, transform


@dataclass(frozen=True)
class SceneModel:
    """What every scene of a configuration is made of. Poses are 4x4 in the world where no seed has moved anything.

    Attributes:
        config: the configuration.
        object_pack: where objects come from.
        object_ids: ids that objects are drawn from.
        room: the room.
        furniture: by the configuration's names.
        furniture_poses: of the furniture's frames.
        basket: the container.
        basket_pose: of its frame.
        robot_pose: of the robot's root, on the floor.
        region: rectangle for objects, in the frame of the furniture it belongs to.
    """

    config: TaskConfig
    object_pack: Pack
    object_ids: tuple[str, ...]
    room: LoadedFurniture
    furniture: dict[str, LoadedFurniture]
    furniture_poses: dict[str, Array]
    basket: LoadedFurniture
    basket_pose: Array
    robot_pose: Array
    region: Region

    @classmethod
    def load(cls, config: TaskConfig, object_pack: Pack, furniture_pack: Pack) -> SceneModel:
        """Look up all assets of a configuration.

        Raises:
            ConfigError: an asset is unknown or can't play its part.
        """
        furniture = {
            name: find_furniture(furniture_pack, item.asset, key=f"furniture.{name}.asset")
            for name, item in config.furniture.items()
        }
        basket = find_container(furniture_pack, config.basket)
        model = cls(
            config=config,
            object_pack=object_pack,
            object_ids=tuple(find_objects(object_pack, config)),
            room=find_room(furniture_pack, config),
            furniture=furniture,
            furniture_poses={name: furniture_pose(config.furniture[name], asset) for name, asset in furniture.items()},
            basket=basket,
            basket_pose=furniture_pose(config.basket, basket),
            robot_pose=fixture_pose(config.robot),
            region=find_region(config.surface, furniture[config.surface.furniture]),
        )
        model._check_joints()
        return model

    def _check_joints(self) -> None:
        for name, item in self.config.furniture.items():
            known = {link.joint.name: link.joint.limits for link in self.furniture[name].asset.links}
            for joint, position in item.joints.items():
                if joint not in known:
                    where = f"furniture.{name}.joints: no such joint"
                    raise ConfigError(where, expected=f"one of {sorted(known)}", found=joint)
                low, high = known[joint]
                if not low <= position <= high:
                    where = f"furniture.{name}.joints.{joint}: out of its limits"
                    raise ConfigError(where, expected=f"{low}..{high}", found=position)
        opening = self.config.opening
        if opening is None:
            return
        handles = self.furniture[opening.furniture].asset.handles
        if opening.handle not in handles:
            raise ConfigError(
                "opening.handle: no such handle", expected=f"one of {sorted(handles)}", found=opening.handle
            )

    @property
    def support_pose(self) -> Array:
        """4x4 of the frame of the furniture that objects stand on."""
        return self.furniture_poses[self.config.surface.furniture]

    @property
    def support_link(self) -> str:
        """Moving part of that furniture that objects stand on; empty: its body."""
        surface = self.config.surface
        return self.furniture[surface.furniture].asset.surfaces[surface.name].link

    @property
    def opened_joint(self) -> Joint | None:
        """The joint that has to be opened, if any."""
        opening = self.config.opening
        if opening is None:
            return None
        asset = self.furniture[opening.furniture].asset
        link_name = asset.handles[opening.handle].link
        return next(link.joint for link in asset.links if link.name == link_name)

    @property
    def opened_position(self) -> float:
        """Joint position, m or rad, from which that joint counts as opened; its sign says which way it opens."""
        joint, opening = self.opened_joint, self.config.opening
        assert joint is not None
        assert opening is not None
        return opening.opened_at * max(joint.limits, key=abs)

    def joint_positions(self, name: str, *, opened: bool) -> dict[str, float]:
        """Positions of a piece of furniture's joints by name: as at first or as the task wants them; others 0."""
        positions = dict(self.config.furniture[name].joints)
        joint, opening = self.opened_joint, self.config.opening
        if opened and joint is not None and opening is not None and opening.furniture == name:
            positions[joint.name] = self.opened_position
        return positions

    def support_motion(self, *, opened: bool) -> Array:
        """4x4 by which joints have moved what objects stand on from where it is when closed, in the support's frame."""
        name = self.config.surface.furniture
        if not self.support_link:
            return np.eye(4)
        positions = self.joint_positions(name, opened=opened)
        return link_poses(self.furniture[name].asset.links, positions)[self.support_link]

    def fixture_points(self, basket_pose: Array, *, opened: bool = False) -> Array:
        """Samples (P, 3) of the collision surfaces of furniture and basket, world, m.

        Args:
            basket_pose: 4x4.
            opened: with what the task wants opened as it should be.
        """
        furniture = self._opened_points if opened else self._closed_points
        return np.concatenate([furniture, transform(basket_pose, self.basket.surface_points())])

    @cached_property
    def _closed_points(self) -> Array:
        return self._furniture_points(opened=False)

    @cached_property
    def _opened_points(self) -> Array:
        return self._furniture_points(opened=True)

    def _furniture_points(self, *, opened: bool) -> Array:
        return np.concatenate(
            [
                transform(self.furniture_poses[n], asset.all_surface_points(self.joint_positions(n, opened=opened)))
                for n, asset in self.furniture.items()
            ]
        )

    @property
    def front(self) -> Array:
        """(2,) unit vector along an axis of the support's frame: from the region to the robot."""
        middle = np.add(self.region.min_xy, self.region.max_xy) / 2
        to_robot = (np.linalg.inv(self.support_pose) @ self.robot_pose)[:2, 3] - middle
        axis = int(np.argmax(np.abs(to_robot)))
        result = np.zeros(2)
        result[axis] = np.sign(to_robot[axis])
        return result


def fixture_pose(config: PoseConfig) -> Array:
    """4x4 of a pose in the configuration."""
    return planar_pose(*config.position, np.deg2rad(config.yaw_deg))


def furniture_pose(config: PlacedConfig, furniture: LoadedFurniture) -> Array:
    """4x4 of a piece of furniture's frame: the configuration says where its lowest point stands."""
    pose = fixture_pose(config.pose)
    pose[2, 3] += furniture.asset.origin_height
    return pose


def find_furniture(pack: Pack, asset_id: str, *, key: str) -> LoadedFurniture:
    """Look up a piece of furniture: an id of the pack, or ``pack/id`` of another one.

    Raises:
        ConfigError: the pack has no such furniture.
        AssetError: there is no such pack.
    """
    other, _, name = asset_id.rpartition("/")
    if other:
        pack = load_pack(other)
    if name not in pack.furniture:
        raise ConfigError(
            f"{key}: no such furniture in pack {pack.name!r}", expected=f"one of {sorted(pack.furniture)}", found=name
        )
    return pack.furniture[name]


def find_room(pack: Pack, config: TaskConfig) -> LoadedFurniture:
    """Look up the room, with its finishes.

    Raises:
        ConfigError: there is no such room, part or finish.
    """
    room = find_furniture(pack, config.room.asset, key="room.asset")
    for part, finish in config.room.finishes.items():
        known = room.asset.finishes.get(part, ())
        if finish not in known:
            expected = f"one of {list(known)}" if known else f"a part among {sorted(room.asset.finishes)}"
            raise ConfigError(f"room.finishes.{part}: no such finish", expected=expected, found=finish)
    for part in config.randomisation.room or ():
        if part not in room.asset.finishes:
            expected = f"one of {sorted(room.asset.finishes)}"
            raise ConfigError("randomisation.room: no such part of the room", expected=expected, found=part)
    return room


def find_container(pack: Pack, config: PlacedConfig) -> LoadedFurniture:
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
    wanted = sorted(pack.objects) if config.objects.ids == "all" else config.objects.ids
    ids = resolve_ids(pack, wanted, key="objects.ids")
    if not ids:
        raise ConfigError(f"objects.ids: pack {pack.name!r} has no objects to choose from")
    for number, names in enumerate(config.randomisation.object_sets or ()):
        resolve_ids(pack, names, key=f"randomisation.object_sets.{number}")
    if config.randomisation.distractors:
        resolve_ids(pack, config.randomisation.distractors.ids, key="randomisation.distractors.ids")
    return ids


def resolve_ids(pack: Pack, wanted: list[str | int] | list[str], *, key: str) -> list[str]:
    """Ids of a pack's objects, from ids or GraspNet-1Billion's numbers.

    Raises:
        ConfigError: one is not in the pack.
    """
    numbers = {
        loaded.asset.graspnet_id: i for i, loaded in pack.objects.items() if loaded.asset.graspnet_id is not None
    }
    ids = [numbers.get(i, str(i)) if isinstance(i, int) else i for i in wanted]
    unknown = [i for i in ids if i not in pack.objects]
    if unknown:
        expected = f"one of {sorted(pack.objects)}" + (
            f", or a GraspNet number of {sorted(numbers)}" if numbers else ""
        )
        raise ConfigError(f"{key}: no such object in pack {pack.name!r}", expected=expected, found=", ".join(unknown))
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
        notes.display_pose,
    )
