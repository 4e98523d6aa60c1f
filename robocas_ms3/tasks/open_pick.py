"""RoboCASOpenPick-v1: open a door or drawer, take the named object out, drop it into the basket."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from mani_skill.utils.structs import Articulation

from robocas_ms3.core.arrays import as_tensor, native, none
from robocas_ms3.scenes.task_specs import OPEN_PICK
from robocas_ms3.tasks import rewards, terms
from robocas_ms3.tasks.bodies import link_poses
from robocas_ms3.tasks.learning import LearningEnv, seen_from
from robocas_ms3.tasks.transfer import STAGES


class RoboCASOpenPickEnv(LearningEnv):
    """Open and pick. The stages begin with ``furniture_opened``: the joint was past ``opening.opened_at`` of its range.

    Success is pick's: how the object got out is up to the policy.
    """

    SPEC = OPEN_PICK
    STAGES = ("furniture_opened", *STAGES)
    REWARDS = rewards.OPEN_PICK

    def overview(self) -> tuple[np.ndarray, np.ndarray]:
        """From above the basket's side, where an opening door does not hide the gripper."""
        model, opening = self.model, self.task_config.opening
        assert opening is not None  # the configuration saw to it
        assert model.basket_pose is not None
        handle = model.furniture[opening.furniture].asset.handles[opening.handle]
        held = model.furniture_poses[opening.furniture] @ np.append(handle.position, 1.0)
        out = model.robot_pose[:2, 3] - held[:2]
        out /= np.linalg.norm(out)
        side = np.array([-out[1], out[0]])
        if side @ (model.basket_pose[:2, 3] - held[:2]) < 0:
            side = -side
        eye = np.append(held[:2] + 0.9 * out + 1.4 * side, held[2] + 0.9)
        middle = np.append(held[:2] + 0.3 * out, held[2] + 0.1)
        return eye, middle

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        opening, joint = self.task_config.opening, self.model.opened_joint
        assert opening is not None  # the configuration saw to it
        assert joint is not None
        furniture = self.fixtures.furniture[opening.furniture]
        assert isinstance(furniture, Articulation)
        self._opening = furniture, [active.name for active in furniture.active_joints].index(joint.name)
        handle = self.model.furniture[opening.furniture].asset.handles[opening.handle]
        # the frames of all parts coincide while everything is shut
        self._handle = furniture.links_map[handle.link], torch.tensor([handle.position], device=self.device)

    def opening_position(self) -> torch.Tensor:
        """(N,) m or rad, where the joint stands that has to be opened."""
        furniture, joint = self._opening
        return furniture.get_qpos()[:, joint]

    def _task_stages(self, objects: Any, held: Any) -> dict[str, Any]:
        """Whether the furniture is open, (N,) bool."""
        goal, position = self.model.opened_position, native(self.opening_position())
        return {"furniture_opened": position >= goal if goal > 0 else position <= goal}

    def _progress(self) -> tuple[Any, dict[str, Any]]:
        """As of `LearningEnv`; before the target may be grasped the furniture must have been opened."""
        stage, found = super()._progress()
        shut = (stage == self.REWARDS.index("grasp")) & ~native(self._stages["furniture_opened"])
        if none(shut):
            return stage, found
        found["handle"] = rewards.closeness(self.tcp_in_world()[:, :3], self._handle_in_world())
        found["open"] = rewards.rise(native(self.opening_position()), 0.0, self.model.opened_position)
        return rewards.furthest(stage, [(shut, self.REWARDS.index("open"))]), found

    def _handle_in_world(self) -> Any:
        """(N, 3) m where the handle is, native (`arrays`)."""
        link, position = self._handle
        pose = native(link_poses(self.scene, [link]))[:, 0]
        return pose[:, :3] + terms.rotate(pose[:, 3:], native(position))

    def _privileged(self) -> dict[str, torch.Tensor]:
        """As of `LearningEnv`, and how far it is open (N, 1), 1 where that is enough, and the handle from the TCP."""
        tcp = self.tcp_in_world()
        opened = rewards.rise(native(self.opening_position()), 0.0, self.model.opened_position)
        return {
            **super()._privileged(),
            "opened_share": as_tensor(opened)[:, None],
            "tcp_to_handle": seen_from(tcp, (self._handle_in_world() - tcp[:, :3])[:, None])[:, 0],
        }
