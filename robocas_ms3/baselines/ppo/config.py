"""Configuration of `ppo`."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from robocas_ms3.core.strict_model import StrictModel

ONE_FRUIT: dict[str, Any] = {  # changes to pick_table_scattered: one small fruit near the gripper
    "description": "A single fruit on a table.",
    "objects": {"ids": ["lemon", "plum"], "count": 1},
    "surface": {"furniture": "table", "name": "top", "min_xy": [0.18, -0.12], "max_xy": [0.34, 0.12]},
    "robot": {"position": [0.9, 0.42, 0.0], "yaw_deg": 90.0},
}
ONE_FRUIT_STEPS = 15  # of 0.2 s per episode


class PpoSettings(StrictModel):
    """Settings of the training.

    Attributes:
        steps: of all environments together; rounded up to whole updates.
        batch_size: steps between updates, of all environments together.
        learning_rate: of the optimiser.
        clip_norm: largest norm of the gradient; 0: no clipping.
        seed: of all random numbers but those of the environments.
        precision: of the forward pass.
        save_every: steps between checkpoints.
    """

    steps: int = Field(default=102_400, ge=1, le=10**9)
    batch_size: int = Field(default=512, ge=2, le=10**6)
    learning_rate: float = Field(default=7e-4, gt=0)
    clip_norm: float = Field(default=0.5, ge=0)
    seed: int = Field(default=0, ge=0)
    precision: Literal["fp32"] = "fp32"
    save_every: int = Field(default=5000, ge=1)


class PpoConfig(StrictModel):
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
        train: see `PpoSettings`.
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
    train: PpoSettings = PpoSettings()
