"""Vector environments of a few short episodes, in processes of their own."""

import os
import time

import numpy as np
import torch

import robocas_ms3

STATE_ONLY = {"render_backend": "none", "control_mode": "pd_joint_delta_pos", "obs_mode": "state"}
HORIZON = 4


def with_gpu(monkeypatch, there: bool) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)


def make(num_envs: int, workers: int, **kwargs):
    kwargs = {"backend": "processes", "max_episode_steps": HORIZON, **STATE_ONLY, **kwargs}
    return robocas_ms3.make_vec("RoboCASPick-v1", num_envs, workers=workers, **kwargs)


def doing(*what: int) -> np.ndarray:
    """Actions that begin with these numbers, one an env."""
    actions = np.zeros((len(what), 8), np.float32)
    actions[:, 0] = what
    return actions


def gone(pids: list[int]) -> bool:
    """Whether processes end within 5 s, and leave nothing."""
    for _ in range(100):
        if not any(os.path.exists(f"/proc/{pid}") for pid in pids):
            return True
        time.sleep(0.05)
    return False
