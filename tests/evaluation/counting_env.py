"""A vector environment without physics; an env succeeds once the first numbers of its actions add up to `ENOUGH`."""

from __future__ import annotations

from typing import Any

import numpy as np

ENOUGH = 5.0
BREAKS = 13.0  # an action with this number raises
_POSE = [1, 2, 3, 0.4, 0.1, 0.2, 0.3]  # m; quaternion wxyz


class CountingEnv:
    def __init__(self, config: str, num_envs: int = 1) -> None:
        self.config, self.num_envs, self.seeds, self.actions, self.closed = config, num_envs, [], [], False
        self.sums, self.elapsed = np.zeros(num_envs), np.zeros(num_envs, int)

    def reset(self, *, seed: list[int], options: dict[str, Any]) -> tuple[Any, dict]:
        envs = list(options["env_idx"])
        assert len(seed) == len(envs)
        self.seeds += seed
        self.sums[envs], self.elapsed[envs] = 0.0, 0
        return self._seen(), self._info()

    def step(self, actions: np.ndarray) -> tuple:
        assert np.isfinite(actions).all()
        if (actions[:, 0] == BREAKS).any():
            raise RuntimeError("the env broke")
        self.actions.append(actions.copy())
        self.sums += actions[:, 0]
        self.elapsed += 1
        return self._seen(), None, None, None, self._info()

    def close(self) -> None:
        self.closed = True

    def _seen(self) -> dict[str, Any]:
        count = self.num_envs
        qpos = np.tile(np.arange(12, dtype=np.float32) + 10, (count, 1))
        tcp = np.tile(np.array(_POSE, np.float32), (count, 1))
        pixels = np.tile(self.elapsed[:, None, None, None], (1, 4, 6, 3)).astype(np.uint8)
        width = np.full((count, 1), 0.05, np.float32)
        return {
            "agent": {"qpos": qpos, "qvel": qpos, "tcp_in_arm_base": tcp, "gripper_width": width},
            "extra": {"tcp_pose": tcp},
            "sensor_data": {"base_camera": {"rgb": pixels, "depth": pixels[..., :1].astype(np.int16) * 100}},
        }

    def _info(self) -> dict[str, Any]:
        no = np.zeros(self.num_envs, bool)
        sums = np.zeros((self.num_envs, 5), np.float32)
        sums[:, 0] = self.sums  # the first is the path's length
        flags = {"reached_any": self.sums > 1, "success": self.sums >= ENOUGH, "fail": no, "success_v0": no}
        return {
            "sums": sums,
            **{name: value.copy() for name, value in flags.items()},
            "elapsed_steps": self.elapsed.copy(),
        }
