"""RoboCASOpenPick-v1: open a door or drawer, take the named object out, and put it into the basket."""

from __future__ import annotations

import numpy as np
import torch
from mani_skill.utils.structs import Articulation
from numpy.typing import NDArray

from robocas_ms3.core import rotations
from robocas_ms3.core.arrays import Array, as_tensor, known_all_false, to_native
from robocas_ms3.scenes.task_specs import OPEN_PICK
from robocas_ms3.tasks import rewards
from robocas_ms3.tasks.base import STAGES, RoboCASEnv
from robocas_ms3.tasks.bodies import read_link_poses
from robocas_ms3.tasks.observations import rotate_to_tcp_frame


class RoboCASOpenPickEnv(RoboCASEnv):
    """Open a door or drawer, and put the named object behind it into the basket.

    The additional stage ``furniture_opened`` is reached when the joint is open by the fraction ``opening.opened_at`` of
    its range. Success has the same conditions as in pick; the furniture need not be open.
    """

    SPEC = OPEN_PICK
    STAGES = ("furniture_opened", *STAGES)
    REWARDS = rewards.OPEN_PICK

    def overview_viewpoint(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return a viewpoint from which an opening door does not hide the gripper.

        Camera position and the point it looks at, (3,) each, world frame, m.
        """
        model, opening = self.model, self.task_config.opening
        assert opening is not None  # checked by the configuration
        assert model.basket_pose is not None
        handle = model.furniture[opening.furniture].asset.handles[opening.handle]
        held = model.furniture_poses[opening.furniture] @ np.append(handle.position, 1.0)
        out = model.robot_pose[:2, 3] - held[:2]
        out /= np.linalg.norm(out)
        side = np.array([-out[1], out[0]])
        if side @ (model.basket_pose[:2, 3] - held[:2]) < 0:
            side = -side
        eye = np.append(held[:2] + 0.9 * out + 1.4 * side, held[2] + 0.9)
        return eye, np.append(held[:2] + 0.3 * out, held[2] + 0.1)

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        opening, joint = self.task_config.opening, self.model.joint_to_open
        assert opening is not None  # checked by the configuration
        assert joint is not None
        furniture = self.fixtures.furniture[opening.furniture]
        assert isinstance(furniture, Articulation)
        self._opening = furniture, [active.name for active in furniture.active_joints].index(joint.name)
        handle = self.model.furniture[opening.furniture].asset.handles[opening.handle]
        # the frames of all parts coincide while the furniture is closed
        self._handle = furniture.links_map[handle.link], to_native(torch.tensor([handle.position], device=self.device))

    def opening_joint_position(self) -> torch.Tensor:
        """Return the position (N,) of the joint that must be opened, m or rad."""
        furniture, joint = self._opening
        return furniture.get_qpos()[:, joint]

    def handle_position(self) -> Array:
        """Return the position (N, 3) of the handle in the world frame, m, as a native array (`core.arrays`)."""
        link, position = self._handle
        pose = read_link_poses(self.scene, [link])[:, 0]
        return pose[:, :3] + rotations.rotate(pose[:, 3:], position)

    def is_furniture_open(self) -> torch.Tensor:
        """Return (N,) bool, whether the joint is currently open by ``opening.opened_at`` of its range."""
        goal, position = self.model.open_threshold, self.opening_joint_position()
        return position >= goal if goal > 0 else position <= goal

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Return the result of `RoboCASEnv.evaluate` and the stage ``furniture_opened`` (N,) bool."""
        found = super().evaluate()
        opened = self.success_check.mark_reached("furniture_opened", to_native(self.is_furniture_open()))
        return {**found, "furniture_opened": opened}

    def reward_stage_and_terms(self) -> tuple[Array, dict[str, Array]]:
        """Return reward stages (N,) and terms (N,) by name; ``open`` is the stage before ``grasp``."""
        stage, found = super().reward_stage_and_terms()
        shut = (stage == self.REWARDS.stage_index("grasp")) & ~self.success_check.stages["furniture_opened"]
        if not known_all_false(shut):
            found["handle"] = rewards.nearness(self.tcp_in_world()[:, :3], self.handle_position())
            found["open"] = self._opened_fraction()
            stage = rewards.furthest_stage(stage, [(shut, self.REWARDS.stage_index("open"))])
        return stage, found

    def _opened_fraction(self) -> Array:
        return rewards.change_fraction(to_native(self.opening_joint_position()), 0.0, self.model.open_threshold)

    def privileged_observations(self) -> dict[str, torch.Tensor]:
        """Return the observations of all tasks, ``opened_fraction`` (N, 1) and ``tcp_to_handle`` (N, 3), m."""
        tcp = self.tcp_in_world()
        return {
            **super().privileged_observations(),
            "opened_fraction": as_tensor(self._opened_fraction())[:, None],
            "tcp_to_handle": rotate_to_tcp_frame(tcp, (self.handle_position() - tcp[:, :3])[:, None])[:, 0],
        }
