"""The other end, as LeRobot's side has it but without LeRobot; and a vector environment without physics."""

from __future__ import annotations

import importlib
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.evaluation.tracking import SUMS

SOURCE = Path(__file__).resolve().parents[3] / "lerobot_env_robocas" / "src" / "lerobot_env_robocas"


def theirs(module: str) -> Any:
    """A module of lerobot_env_robocas; the package itself registers with LeRobot, which is not here."""
    if "lerobot_env_robocas" not in sys.modules:
        package = types.ModuleType("lerobot_env_robocas")
        package.__path__ = [str(SOURCE)]
        sys.modules["lerobot_env_robocas"] = package
    return importlib.import_module(f"lerobot_env_robocas.{module}")


class Counting:
    """N envs of which each succeeds once the first numbers of its actions sum up to its seed's last digit."""

    def __init__(self, num_envs: int) -> None:
        self.num_envs, self.closed = num_envs, False
        self.seeds, self.sums = np.zeros(num_envs, int), np.zeros(num_envs)
        self.elapsed = np.zeros(num_envs, np.int32)

    def reset(self, *, seed: list[int], options: dict[str, Any]) -> tuple[Any, dict]:
        envs = options["env_idx"]
        self.seeds[envs], self.sums[envs], self.elapsed[envs] = np.array(seed) % 10, 0, 0
        return self._seen(), self._info()

    def step(self, actions: np.ndarray) -> tuple:
        self.sums += actions[:, 0]
        self.elapsed += 1
        return self._seen(), None, None, None, self._info()

    def close(self) -> None:
        self.closed = True

    def _seen(self) -> dict[str, Any]:
        count = self.num_envs
        pose = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (count, 1))
        joints = np.zeros((count, 12), np.float32)
        joints[:, 3] = self.sums  # the first of the arm
        agent = {"qpos": joints, "qvel": joints, "tcp_in_arm_base": pose, "gripper_width": joints[:, :1]}
        pictures = np.tile(self.sums.astype(np.uint8)[:, None, None, None], (1, 4, 6, 3))
        return {"agent": agent, "extra": {"tcp_pose": pose}, "sensor_data": {"base_camera": {"rgb": pictures}}}

    def _info(self) -> dict[str, Any]:
        tracked = {"sums": np.zeros((self.num_envs, len(SUMS)), np.float32)}
        done = self.sums >= self.seeds + 2
        return {**tracked, "success": done, "fail": ~done & False, "elapsed_steps": self.elapsed.copy()}
