"""What the `ppo` baseline learns, and how."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from robocas_ms3.baselines.baseline import TrialConfig, TrialSettings

ONE_FRUIT: dict[str, Any] = {  # of pick_table_scattered: one small fruit, more or less under the gripper
    "description": "A single fruit on a table.",
    "objects": {"ids": ["lemon", "plum"], "count": 1},
    "surface": {"furniture": "table", "name": "top", "min_xy": [0.18, -0.12], "max_xy": [0.34, 0.12]},
    "robot": {"position": [0.9, 0.42, 0.0], "yaw_deg": 90.0},
}
ONE_FRUIT_STEPS = 15  # an episode, of 0.2 s: to reach for it and hold it


class PpoConfig(TrialConfig):
    """Configuration of `ppo` (Schulman et al. 2017).

    Attributes:
        task: to learn, by its short name.
        scenes: a shipped configuration or a YAML file; None: of a single fruit on a table, which a CPU can learn to
            reach for and hold in minutes.
        horizon: steps of 0.2 s an episode takes; None: 15 for the single fruit, else those of docs/rl.md.
        layouts: different scenes to learn from.
        envs: that are tried in side by side.
        workers: processes that they are in, on a CPU; None: one an environment, but no more than cores.
        epochs, minibatches: how often what was tried is learned from, and in how many parts.
        gamma, trace: discount, and lambda of the advantages.
        clip: how far the policy may move away from the one that tried, as a ratio of probabilities.
        entropy: weight of the policy's entropy.
        width: of its two layers.
        trials: episodes at the end, in layouts that were not learned from, without noise; 0: none.
        train: see `TrialSettings`.
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
    train: TrialSettings = TrialSettings(steps=102_400, batch_size=512, learning_rate=7e-4, clip_norm=0.5)
