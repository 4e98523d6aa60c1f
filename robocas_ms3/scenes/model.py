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
    """A task configuration with its assets. Poses are (4, 4) in the world frame, before randomisation.

    Attributes:
        config: the task configuration.
        object_pack: pack of the objects.
        object_ids: ids from which objects are drawn.
        room: the room.
        furniture: furniture by name in the configuration.
        furniture_poses: pose of the frame of each piece of furniture, by name.
        basket: the basket; None if the scene has none.
        basket_pose: pose of the basket's frame; None if the scene has no basket.
        robot_pose: pose of the robot's root on the floor.
        region: rectangle on which objects are placed, in the frame of the supporting furniture.
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
        """Look up all assets of a configuration, and check overlaps and reach.

        Args:
            config: the task configuration.
            object_pack: pack of the objects.
            furniture_pack: pack of room, furniture and basket.
            robot: description of the robot whose body and reach are checked.

        Raises:
            ConfigError: an asset is unknown or unsuitable, bodies overlap, or the arm does not reach basket or objects.
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
        """Pose (4, 4) in the world of the furniture on which objects are placed."""
        return self.furniture_poses[self.config.surface.furniture]

    @property
    def headroom(self) -> float:
        """Free height above the surface of the objects, m; infinite if nothing is above it."""
        surface = self.config.surface
        return self.furniture[surface.furniture].asset.surfaces[surface.name].headroom or np.inf

    @property
    def support_link(self) -> str:
        """Name of the moving part on which objects are placed; empty: the fixed body of the furniture."""
        surface = self.config.surface
        return self.furniture[surface.furniture].asset.surfaces[surface.name].link

    @property
    def joint_to_open(self) -> Joint | None:
        """Joint of the door or drawer that the task opens; None for other tasks."""
        return find_joint_to_open(self.config, self.furniture) if self.config.opening else None

    @property
    def open_threshold(self) -> float:
        """Position of `joint_to_open` from which it counts as open, m or rad; negative if it opens that way."""
        joint, opening = self.joint_to_open, self.config.opening
        assert joint is not None
        assert opening is not None
        return opening.opened_at * max(joint.limits, key=abs)

    def joint_positions(self, name: str, *, opened: bool) -> dict[str, float]:
        """Return joint name -> position, m or rad, of a piece of furniture.

        Joints that are not in the result are at 0.

        Args:
            name: name of the furniture in the configuration.
            opened: whether the door or drawer of the task is open; false: positions at the start of an episode.
        """
        positions = dict(self.config.furniture[name].joints)
        joint, opening = self.joint_to_open, self.config.opening
        if opened and joint is not None and opening is not None and opening.furniture == name:
            positions[joint.name] = self.open_threshold
        return positions

    def support_motion(self, *, opened: bool) -> Array:
        """Return the motion (4, 4) of the objects' surface from its pose with closed joints.

        The motion is in the frame of the furniture.

        Args:
            opened: whether the door or drawer of the task is open; false: positions at the start of an episode.
        """
        name = self.config.surface.furniture
        if not self.support_link:
            return np.eye(4)
        positions = self.joint_positions(name, opened=opened)
        return link_poses(self.furniture[name].asset.links, positions)[self.support_link]

    def fixture_points(self, basket_pose: Array | None, *, opened: bool = False) -> Array:
        """Return points (P, 3) on the collision surfaces of furniture and basket, world frame, m.

        Args:
            basket_pose: (4, 4) pose of the basket in the world; None if the scene has no basket.
            opened: whether the door or drawer of the task is open; false: positions at the start of an episode.
        """
        furniture = self._opened_points if opened else self.furniture_points
        if self.basket is None or basket_pose is None:
            return furniture
        return np.concatenate([furniture, transform_points(basket_pose, self.basket.surface_points())])

    @cached_property
    def furniture_points(self) -> Array:
        """Points (P, 3) on the collision surfaces of the furniture at the start of an episode, world frame, m."""
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
    def front_direction(self) -> Array:
        """Unit vector (2,) out of the front edge of the region, in the furniture's frame.

        It is the signed axis of that frame that is nearest to the direction of the robot.
        """
        middle = np.add(self.region.min_xy, self.region.max_xy) / 2
        to_robot = (np.linalg.inv(self.support_pose) @ self.robot_pose)[:2, 3] - middle
        axis = int(np.argmax(np.abs(to_robot)))
        result = np.zeros(2)
        result[axis] = np.sign(to_robot[axis])
        return result
