"""How the `bc-state` baseline thinks and is trained."""

from __future__ import annotations

from pydantic import Field

from robocas_ms3.baselines.baseline import BaselineConfig, TrainSettings


class BcStateConfig(BaselineConfig):
    """Configuration of `bc-state`.

    Attributes:
        rate_hz: steps a second that it acts in.
        chunk: steps it predicts.
        width: of its layers.
        blocks: residual blocks of two layers each.
        dropout: between them.
        noise: deviation of the noise on what it is told in training, in deviations of that.
        keys_weight, gripper_weight, near: see `SmallConfig`.
        play: steps of a chunk that it follows before it predicts the next one.
        fade: how fast older predictions lose weight when it acts, see `ChunkPolicy`.
        train: see `TrainSettings`.
    """

    rate_hz: float = Field(default=5.0, gt=0, le=100)
    chunk: int = Field(default=8, ge=1, le=1000)
    width: int = Field(default=384, ge=8, le=16384)
    blocks: int = Field(default=4, ge=1, le=1000)
    dropout: float = Field(default=0.1, ge=0, lt=1)
    noise: float = Field(default=0.02, ge=0)
    keys_weight: float = Field(default=0.5, ge=0)
    gripper_weight: float = Field(default=0.5, ge=0)
    near: float = Field(default=0.0, ge=0)
    play: int = Field(default=1, ge=1, le=1000)
    fade: float = Field(default=0.5, ge=0)
    train: TrainSettings = TrainSettings(
        steps=20_000, batch_size=256, learning_rate=1e-3, weight_decay=0.01, precision="fp32"
    )
