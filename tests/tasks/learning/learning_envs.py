"""Environments that learning is tested in: things put where they matter, and what is earned for it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from mani_skill.utils.structs import Pose

STATE_ONLY: dict[str, Any] = {"render_backend": "none", "control_mode": "pd_joint_pos"}


def held_still(env, gripper: float = 1.0) -> np.ndarray:
    return np.append(env.unwrapped.agent.robot.get_qpos()[0, 3:10].numpy(), gripper).astype(np.float32)


def target_of(base) -> Any:
    return base.objects[int(base.target_slot[0])]


def put(actor, position) -> None:
    actor.set_pose(Pose.create_from_pq(torch.as_tensor(position).reshape(1, 3), actor.pose.q))
    actor.set_linear_velocity(torch.zeros(1, 3))
    actor.set_angular_velocity(torch.zeros(1, 3))


def reward_now(base) -> tuple[float, dict[str, float], dict]:
    info = base.get_info()
    reward = base.get_reward({}, None, info)
    assert reward.shape == (1,)
    assert reward.dtype == torch.float32
    return reward.item(), {name: term.item() for name, term in info["reward_terms"].items()}, info
