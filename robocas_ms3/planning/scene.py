"""Read obstacles and poses of an environment for motion planning.

Obstacles are bodies or point clouds.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace

import numpy as np
from mani_skill.utils.structs import Articulation

from robocas_ms3.assets.kinematics import link_poses
from robocas_ms3.assets.pack import BodyFiles
from robocas_ms3.core.poses import from_wxyz, inverse, transform_points
from robocas_ms3.planning.protocol import Array, Obstacle, Shape
from robocas_ms3.tasks.base import RoboCASEnv

# m between surface points; RADIUS: m from the robot, both as in RoboCAS-v0
SPACING = 0.005
# m between surface points of furniture: a cupboard has a million points at 5 mm, which takes 0.5 s per cloud, and no
# link fits between points 1 cm apart
FURNITURE_SPACING = 0.01
RADIUS = 1.5
BASKET = "basket"  # name of the basket as an obstacle


_SHAPES: dict[int, tuple[BodyFiles, Shape]] = {}  # by id of the body, which is unique since the body is kept


def get_body_shape(part: BodyFiles) -> Shape:
    """Return the shape of a body; repeated calls return the same object, so that planners can cache it."""
    if id(part) not in _SHAPES:
        _SHAPES[id(part)] = part, Shape(tuple(part.hulls))
    return _SHAPES[id(part)][1]


def _compute_extent(part: BodyFiles) -> float:
    return max(math.sqrt(np.einsum("ij,ij->i", hull, hull).max()) for hull in part.hulls)


def to_arm_base_frame(obstacles_in_world: Iterable[Obstacle], arm_base_in_world: Array) -> list[Obstacle]:
    """Transform the poses of obstacles from the world frame to the frame of an arm's base.

    Args:
        obstacles_in_world: obstacles whose ``pose_in_base`` is a pose in the world frame.
        arm_base_in_world: (4x4) pose of the arm's base in the world frame.
    """
    to_base = inverse(arm_base_in_world)
    return [replace(body, pose_in_base=to_base @ body.pose_in_base) for body in obstacles_in_world]


class PlanningScene:
    """Current poses (4x4) and bodies of one environment.

    They are in the arm's base frame, unless the name says ``in_world``.

    Planners use bodies (`obstacles`); geometric tests use surface points (`points_in_base`).
    """

    def __init__(self, env: RoboCASEnv) -> None:
        self.env = env

    def _bodies(
        self, excluded: Collection[int], exclude_link: tuple[str, str] | None
    ) -> Iterator[tuple[str, BodyFiles, float, Array]]:
        """Yield name, files, spacing of the surface points (m) and world pose (4x4) of each body.

        Args:
            excluded: slots of objects to omit.
            exclude_link: names of a piece of furniture and of its link to omit.
        """
        for name, asset in self.env.model.furniture.items():
            frame = self.env.model.furniture_poses[name]
            yield name, asset, FURNITURE_SPACING, frame
            for link, pose in link_poses(asset.asset.links, self.joint_positions(name)).items():
                if (name, link) != exclude_link:
                    yield f"{name}/{link}", asset.links[link], FURNITURE_SPACING, frame @ pose
        if self.env.model.basket is not None:
            yield BASKET, self.env.model.basket, SPACING, from_wxyz(self.env.basket_pose[0])
        present, poses = self.env.present[0].tolist(), self.env.object_states[0, :, :7]
        for slot, asset in enumerate(self.env.object_assets[0]):
            if present[slot] and slot not in excluded:
                yield asset.asset.id, asset, SPACING, from_wxyz(poses[slot])

    def sample_surfaces(self) -> None:
        """Sample and cache surface points of all bodies; a forked process would sample them again."""
        for _, part, spacing, _ in self._bodies((), None):
            part.surface_points(spacing)

    def joint_positions(self, furniture: str) -> dict[str, float]:
        built = self.env.fixtures.furniture[furniture]
        if not isinstance(built, Articulation):
            return {}
        return dict(zip((j.name for j in built.active_joints), built.get_qpos()[0].tolist(), strict=True))

    @property
    def arm_base_in_world(self) -> Array:
        return from_wxyz(self.env.agent.arm_base_link.pose.raw_pose[0])

    @property
    def tcp_in_base(self) -> Array:
        return inverse(self.arm_base_in_world) @ from_wxyz(self.env.agent.tcp.pose.raw_pose[0])

    @property
    def arm_qpos(self) -> Array:
        return self.env.agent.robot.get_qpos()[0, self.env.agent.description.arm_slice].cpu().numpy().astype(float)

    def object_in_base(self, slot: int) -> Array:
        return inverse(self.arm_base_in_world) @ from_wxyz(self.env.object_states[0, slot, :7])

    def object_points(self, slot: int) -> Array:
        """Return surface points (P, 3) of the object in a slot, m."""
        return transform_points(self.object_in_base(slot), self.env.object_assets[0][slot].surface_points(SPACING))

    @property
    def basket_in_base(self) -> Array:
        return inverse(self.arm_base_in_world) @ from_wxyz(self.env.basket_pose[0])

    def obstacles(
        self,
        *,
        exclude: int | Collection[int] = (),
        exclude_link: tuple[str, str] | None = None,
        clearance: float = 0.0,
    ) -> list[Obstacle]:
        """Return furniture, basket and objects of the episode as obstacles.

        Args:
            exclude: slots of objects to omit.
            exclude_link: names of a piece of furniture and of its link to omit.
            clearance: minimum distance of the arm to furniture and basket, m; to objects it is 0.
        """
        bodies = self.obstacles_in_world(exclude=exclude, exclude_link=exclude_link)
        objects = {asset.asset.id for asset in self.env.object_assets[0]}
        bodies = [body if body.name in objects else replace(body, clearance=clearance) for body in bodies]
        return to_arm_base_frame(bodies, self.arm_base_in_world)

    def obstacles_in_world(
        self,
        *,
        exclude: int | Collection[int] = (),
        exclude_link: tuple[str, str] | None = None,
    ) -> list[Obstacle]:
        """Return furniture, basket and objects of the episode, with ``pose_in_base`` in the world frame.

        `to_arm_base_frame` converts the poses.

        Args:
            exclude: slots of objects to omit.
            exclude_link: names of a piece of furniture and of its link to omit.
        """
        excluded = {exclude} if isinstance(exclude, int) else exclude
        return [
            Obstacle(name, get_body_shape(part), pose) for name, part, _, pose in self._bodies(excluded, exclude_link)
        ]

    def points_in_base(
        self,
        *,
        exclude: int | Collection[int] = (),
        radius: float = RADIUS,
        around: Array | None = None,
    ) -> Array:
        """Return surface points (P, 3) of furniture, basket and objects of the episode, m.

        Args:
            exclude: slots of objects to omit.
            radius: maximum distance of points from ``around``, m.
            around: (3,) centre; default: the origin of the arm's base frame.
        """
        to_base = inverse(self.arm_base_in_world)
        center = np.zeros(3) if around is None else around
        excluded = {exclude} if isinstance(exclude, int) else exclude
        pieces: list[Array] = [np.zeros((0, 3))]
        for _, part, spacing, pose in self._bodies(excluded, None):
            in_base, points = to_base @ pose, part.surface_points(spacing)
            middle = (center - in_base[:3, 3]) @ in_base[:3, :3]
            if np.linalg.norm(middle) + _compute_extent(part) > radius:  # the body may extend beyond the radius
                away = points - middle
                points = points[np.einsum("ij,ij->i", away, away) <= radius**2]
            if len(points):
                pieces.append(transform_points(in_base, points))
        return np.concatenate(pieces)
