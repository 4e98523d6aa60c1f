"""Configuration of `ppo`."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from robocas_ms3.baselines.baseline import RLConfig, RLSettings

ONE_FRUIT: dict[str, Any] = {  # changes to pick_table_scattered: one small fruit near the gripper
    "description": "A single fruit on a table.",
    "objects": {"ids": ["lemon", "plum"], "count": 1},
    "surface": {"furniture": "table", "name": "top", "min_xy": [0.18, -0.12], "max_xy": [0.34, 0.12]},
    "robot": {"position": [0.9, 0.42, 0.0], "yaw_deg": 90.0},
}
ONE_FRUIT_STEPS = 15  # of 0.2 s per episode


class PpoConfig(RLConfig):
    """Configuration of `ppo` (Schulman et al. 2017).

    Attributes:
        task: short name of the task.
        scenes: a bundled configuration or a YAML file; None: a single fruit on a table, which an agent learns to reach
            and hold on a CPU in minutes.
        horizon: steps of 0.2 s per episode; None: 15 for the single fruit, else those of docs/rl.md.
        layouts: number of different scenes.
        envs: number of environments.
        workers: processes with the environments, on a CPU; None: one per environment, at most one per core.
        epochs, minibatches: passes over each rollout, and the number of its parts.
        gamma, trace: discount, and lambda of the advantages.
        clip: range of the ratio of probabilities.
        entropy: weight of the entropy.
        width: of the two layers.
        trials: test episodes at the end, in other layouts and without noise; 0: none.
        train: see `RLSettings`.
    """

    task: str = "pick"
    scenes: str | None = None
    horizon: int | None = Field(default=None, ge=1)
    layouts: int = Field(default=64, ge=1, le=20_000)
    envs: int = Field(default=8, ge=1)
    workers: int | None = Field(default=None, ge=1)
    epochs: int = Field(default=10, ge=1)
    minibatches: int = Field(default=4, ge=1)
    gamma: float = Field(default=0.92, ge=0, lt=1)
    trace: float = Field(default=0.9, ge=0, le=1)
    clip: float = Field(default=0.2, gt=0)
    entropy: float = Field(default=1e-3, ge=0)
    width: int = Field(default=128, ge=1, le=16384)
    trials: int = Field(default=50, ge=0)
    train: RLSettings = RLSettings(steps=102_400, batch_size=512, learning_rate=7e-4, clip_norm=0.5)
