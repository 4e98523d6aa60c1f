"""A vector environment of one env without physics, which succeeds once its actions have come to a number."""

from __future__ import annotations

from typing import Any

import numpy as np

ENOUGH = 5.0


class CountingEnv:
    num_envs = 1

    def __init__(self, config: str) -> None:
        self.config, self.seeds, self.actions, self.closed = config, [], [], False
        self.sum, self.elapsed = 0.0, 0

    def reset(self, *, seed: list[int], options: dict[str, Any]) -> tuple[Any, dict]:
        assert list(options["env_idx"]) == [0]
        self.seeds += seed
        self.sum, self.elapsed = 0.0, 0
        return self._seen(), self._info()

    def step(self, actions: np.ndarray) -> tuple:
        if actions[0, 0] == 13:
            raise RuntimeError("the env broke")
        self.actions.append(actions[0].copy())
        self.sum += float(actions[0, 0])
        self.elapsed += 1
        return self._seen(), None, None, None, self._info()

    def close(self) -> None:
        self.closed = True

    def _seen(self) -> dict[str, Any]:
        qpos = np.arange(12, dtype=np.float32)[None] + 10
        tcp = np.array([[1, 2, 3, 0.4, 0.1, 0.2, 0.3]], np.float32)
        image = np.full((1, 4, 6, 3), self.elapsed, np.uint8)
        return {
            "agent": {"qpos": qpos, "tcp_in_arm_base": tcp, "gripper_width": np.array([[0.05]], np.float32)},
            "extra": {},
            "sensor_data": {"base_camera": {"rgb": image}},
        }

    def _info(self) -> dict[str, Any]:
        flags = {"reached_any": self.sum > 1, "success": self.sum >= ENOUGH, "fail": False, "success_v0": False}
        return {
            "sums": np.array([[self.sum, 0, 0, 0, 0]], np.float32),  # the first is the path's length
            **{name: np.array([value]) for name, value in flags.items()},
            "elapsed_steps": np.array([self.elapsed]),
        }
