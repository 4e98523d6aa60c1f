"""What a planner has to know of an environment: obstacle clouds, poses as matrices."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import torch
from mani_skill.utils.structs import Articulation
from scipy.spatial.transform import Rotation

from robocas_ms3.assets.kinematics import link_poses
from robocas_ms3.planning.protocol import Array
from robocas_ms3.scenes.placement import transform
from robocas_ms3.tasks.transfer import TransferEnv

# Upstream's: samples of the meshes at 5 mm, none farther than 1.5 m from the robot
SPACING = 0.005
# Of furniture, which is large: a cupboard has a million points at 5 mm, half a second for each of a plan's many clouds;
# no link fits between two points a centimetre apart.
FURNITURE_SPACING = 0.01
RADIUS = 1.5


def matrix(raw_pose: torch.Tensor) -> Array:
    """4x4 of a pose (7,): position m, quaternion wxyz."""
    values = raw_pose.detach().cpu().numpy().astype(float)
    result = np.eye(4)
    result[:3, :3] = Rotation.from_quat(values[[4, 5, 6, 3]]).as_matrix()
    result[:3, 3] = values[:3]
    return result


def inverse(pose: Array) -> Array:
    """Inverse of a rigid 4x4."""
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return result


class PlanningScene:
    """Reads one environment (``num_envs`` = 1) as a planner sees it. All clouds are in the arm's base frame, m."""

    def __init__(self, env: TransferEnv) -> None:
        self.env = env

    def _furniture_in_world(self, without: tuple[str, str] | None) -> Array:
        """Samples (P, 3) of the surfaces of all furniture, its doors and drawers as they stand."""
        pieces = []
        for name, asset in self.env.model.furniture.items():
            frame = self.env.model.furniture_poses[name]
            pieces.append(transform(frame, asset.surface_points(FURNITURE_SPACING)))
            for link, pose in link_poses(asset.asset.links, self.joint_positions(name)).items():
                if (name, link) != without:
                    pieces.append(transform(frame @ pose, asset.links[link].surface_points(FURNITURE_SPACING)))
        return np.concatenate(pieces)

    def joint_positions(self, furniture: str) -> dict[str, float]:
        """Positions of a piece of furniture's joints by name, m or rad."""
        built = self.env.fixtures.furniture[furniture]
        if not isinstance(built, Articulation):
            return {}
        return dict(zip((j.name for j in built.active_joints), built.get_qpos()[0].tolist(), strict=True))

    @property
    def arm_base_in_world(self) -> Array:
        """4x4 of ``panda_link0`` in the world."""
        return matrix(self.env.agent.arm_base_link.pose.raw_pose[0])

    @property
    def tcp_in_base(self) -> Array:
        """4x4 of the TCP in the arm's base frame."""
        return inverse(self.arm_base_in_world) @ matrix(self.env.agent.tcp.pose.raw_pose[0])

    @property
    def arm_qpos(self) -> Array:
        """(7,) rad, where the arm is."""
        return self.env.agent.robot.get_qpos()[0, 3:10].cpu().numpy().astype(float)

    def object_in_base(self, slot: int) -> Array:
        """4x4 of an object in the arm's base frame."""
        return inverse(self.arm_base_in_world) @ matrix(self.env.objects[slot].pose.raw_pose[0])

    @property
    def basket_in_base(self) -> Array:
        """4x4 of the basket's frame in the arm's base frame."""
        return inverse(self.arm_base_in_world) @ matrix(self.env.fixtures.basket.pose.raw_pose[0])

    def obstacles_in_base(
        self,
        *,
        without: int | Collection[int] = (),
        without_link: tuple[str, str] | None = None,
        radius: float = RADIUS,
    ) -> Array:
        """Samples (P, 3) of the collision surfaces of furniture, basket and the objects that are there.

        Args:
            without: slot or slots of objects to leave out.
            without_link: a piece of furniture and its moving part to leave out.
            radius: m, from the arm's base as it stands; beyond it they are left out.
        """
        to_base = inverse(self.arm_base_in_world)
        left_out = {without} if isinstance(without, int) else set(without)
        present = self.env.present[0].tolist()
        pieces = [
            transform(to_base, self._furniture_in_world(without_link)),
            transform(self.basket_in_base, self.env.model.basket.surface_points(SPACING)),
        ]
        for slot, asset in enumerate(self.env.object_assets[0]):
            if present[slot] and slot not in left_out:
                pieces.append(transform(self.object_in_base(slot), asset.surface_points(SPACING)))
        points = np.concatenate(pieces)
        return points[np.linalg.norm(points, axis=1) <= radius]
