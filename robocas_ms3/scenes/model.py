"""The assets of a configuration, looked up and checked. No simulator."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robocas_ms3.assets.kinematics import link_poses
from robocas_ms3.assets.manifest import Joint
from robocas_ms3.assets.pack import LoadedFurniture, Pack
from robocas_ms3.core.poses import transform_points
from robocas_ms3.robots.description import MOBILE_PANDA, RobotDescription
from robocas_ms3.scenes.clearance import check_clearance
from robocas_ms3.scenes.config.task import TaskConfig
from robocas_ms3.scenes.lookup import (
    check_joints,
    find_container,
    find_furniture,
    find_joint_to_open,
    find_objects,
    find_region,
    find_room,
    fixture_pose,
    furniture_pose,
)
from robocas_ms3.scenes.placement import Array, Region


@dataclass(frozen=True)
class SceneModel:
    """A configuration with its assets. Poses are 4x4 in the world, before randomisation.

    Attributes:
        config: the configuration.
        object_pack: pack of the objects.
        object_ids: ids from which objects are drawn.
        room: the room.
        furniture: furniture by its name in the configuration.
        furniture_poses: poses of the furniture's frames.
        basket: the container; None if the scene has none.
        basket_pose: pose of the basket's frame.
        robot_pose: pose of the robot's root on the floor.
        region: rectangle for objects, in the frame of its furniture.
    """

    config: TaskConfig
    object_pack: Pack
    object_ids: tuple[str, ...]
    room: LoadedFurniture
    furniture: dict[str, LoadedFurniture]
    furniture_poses: dict[str, Array]
    basket: LoadedFurniture | None
    basket_pose: Array | None
    robot_pose: Array
    region: Region

    @classmethod
    def load(
        cls,
        config: TaskConfig,
        object_pack: Pack,
        furniture_pack: Pack,
        *,
        robot: RobotDescription = MOBILE_PANDA,
    ) -> SceneModel:
        """Look up all assets of a configuration.

        Raises:
            ConfigError: an asset is unknown or unsuitable, or things overlap or are out of the robot's reach.
        """
        furniture = {
            name: find_furniture(furniture_pack, item.asset, key=f"furniture.{name}.asset")
            for name, item in config.furniture.items()
        }
        basket = find_container(furniture_pack, config.basket) if config.basket else None
        model = cls(
            config=config,
            object_pack=object_pack,
            object_ids=tuple(find_objects(object_pack, config)),
            room=find_room(furniture_pack, config),
            furniture=furniture,
            furniture_poses={name: furniture_pose(config.furniture[name], asset) for name, asset in furniture.items()},
            basket=basket,
            basket_pose=furniture_pose(config.basket, basket) if config.basket and basket else None,
            robot_pose=fixture_pose(config.robot),
            region=find_region(config.surface, furniture[config.surface.furniture]),
        )
        check_joints(config, furniture)
        placed = {f"furniture.{name}": (asset, model.furniture_poses[name]) for name, asset in furniture.items()}
        placed["room"] = model.room, np.eye(4)
        if basket and model.basket_pose is not None:
            placed["basket"] = basket, model.basket_pose
        frame = model.support_pose @ model.support_motion(opened=True)
        check_clearance(config, placed, (model.region, frame), model.robot_pose, robot)
        return model

    @property
    def support_pose(self) -> Array:
        """4x4 pose of the furniture on which objects stand."""
        return self.furniture_poses[self.config.surface.furniture]

    @property
    def headroom(self) -> float:
        """Free height above the surface, m; infinite if nothing is above it."""
        surface = self.config.surface
        return self.furniture[surface.furniture].asset.surfaces[surface.name].headroom or np.inf

    @property
    def support_link(self) -> str:
        """Moving part on which objects stand; empty: the body of the furniture."""
        surface = self.config.surface
        return self.furniture[surface.furniture].asset.surfaces[surface.name].link

    @property
    def joint_to_open(self) -> Joint | None:
        return find_joint_to_open(self.config, self.furniture) if self.config.opening else None

    @property
    def open_threshold(self) -> float:
        """Joint position, m or rad, from which the joint to open counts as open; signed."""
        joint, opening = self.joint_to_open, self.config.opening
        assert joint is not None
        assert opening is not None
        return opening.opened_at * max(joint.limits, key=abs)

    def joint_positions(self, name: str, *, opened: bool) -> dict[str, float]:
        """Return joint positions of a piece of furniture by name, at the start or opened; others are 0."""
        positions = dict(self.config.furniture[name].joints)
        joint, opening = self.joint_to_open, self.config.opening
        if opened and joint is not None and opening is not None and opening.furniture == name:
            positions[joint.name] = self.open_threshold
        return positions

    def support_motion(self, *, opened: bool) -> Array:
        """Return the 4x4 motion of the surface from its closed pose, in the support's frame."""
        name = self.config.surface.furniture
        if not self.support_link:
            return np.eye(4)
        positions = self.joint_positions(name, opened=opened)
        return link_poses(self.furniture[name].asset.links, positions)[self.support_link]

    def fixture_points(self, basket_pose: Array | None, *, opened: bool = False) -> Array:
        """Return samples (P, 3) of the collision surfaces of furniture and basket, world, m.

        Args:
            basket_pose: 4x4; None if the scene has no basket.
            opened: whether the door or drawer of the task is open.
        """
        furniture = self._opened_points if opened else self.furniture_points
        if self.basket is None or basket_pose is None:
            return furniture
        return np.concatenate([furniture, transform_points(basket_pose, self.basket.surface_points())])

    @cached_property
    def furniture_points(self) -> Array:
        """Samples (P, 3) of the collision surfaces of furniture, doors and drawers at their start, world, m."""
        return self._furniture_points(opened=False)

    @cached_property
    def _opened_points(self) -> Array:
        return self._furniture_points(opened=True)

    def _furniture_points(self, *, opened: bool) -> Array:
        return np.concatenate(
            [
                transform_points(
                    self.furniture_poses[n], asset.all_surface_points(self.joint_positions(n, opened=opened))
                )
                for n, asset in self.furniture.items()
            ]
        )

    @property
    def front(self) -> Array:
        """Unit vector (2,) from the region to the robot, along the nearest axis of the support's frame."""
        middle = np.add(self.region.min_xy, self.region.max_xy) / 2
        to_robot = (np.linalg.inv(self.support_pose) @ self.robot_pose)[:2, 3] - middle
        axis = int(np.argmax(np.abs(to_robot)))
        result = np.zeros(2)
        result[axis] = np.sign(to_robot[axis])
        return result
