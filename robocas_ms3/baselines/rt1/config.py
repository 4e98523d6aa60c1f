"""Configuration of `rt1`; the defaults are those of the RoboCAS paper's RT-1.

The defaults come from RoboCAS-v0's training configuration. Its batch size is 24 on one GPU; the paper's is 64. Values
that it does not contain, such as the width of TokenLearner's hidden layer, come from RT-1 (Brohan et al. 2022) and its
code.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from robocas_ms3.baselines.baseline import BaselineConfig, Fraction, TrainSettings

_IMAGENET_STD = (0.229, 0.224, 0.225)
_KERAS_STD = (0.47853944, 0.4732864, 0.47434163)
"""Standard deviations of EfficientNet's published weights: the square roots of ImageNet's; transformers uses them."""


class RT1TrainSettings(TrainSettings):
    """Training settings of RT-1.

    140 000 steps of 24 samples are 20 epochs, as in RoboCAS-v0's code, of 2800 episodes with about 60 steps, as in the
    paper. The defaults are fields of a subclass, so a configuration can change one of them and keep the others.
    """

    steps: int = Field(default=140_000, ge=1)
    batch_size: int = Field(default=24, ge=1)
    learning_rate: float = Field(default=1e-4, gt=0)
    min_learning_rate: float = Field(default=1e-5, ge=0)
    weight_decay: float = Field(default=0.01, ge=0)
    betas: tuple[Fraction, Fraction] = (0.9, 0.999)  # defaults of AdamW; RoboCAS-v0 gives no values
    warmup_steps: int = Field(default=0, ge=0)
    schedule: Literal["cosine", "constant", "restarts"] = "restarts"
    restart_epochs: float = Field(default=20, gt=0)
    restart_factor: int = Field(default=2, ge=1)
    clip_norm: float = Field(default=4.0, ge=0)
    ema: float = Field(default=0.0, ge=0, lt=1)
    workers: int = Field(default=4, ge=0)
    validate_every: int = Field(default=5000, ge=1)
    save_every: int = Field(default=2000, ge=1)


class RT1Config(BaselineConfig):
    """Configuration of `rt1`.

    Attributes:
        cameras: cameras with one encoder each; their tokens are concatenated in this order.
        image_size: width and height that images are scaled to, pixels.
        crop_height: number of image rows that the network observes: random rows in training, the middle rows in
            evaluation.
        rate_hz: policy steps per second, of the data and of the policy.
        frames: number of observed policy steps, the present step included.
        image_width, image_depth: width and depth coefficients of EfficientNet; 1.2 and 1.4 are EfficientNet-B3.
        drop_connect: probability that training skips the last block of EfficientNet. It decreases linearly to 0 for the
            first block.
        norm_momentum: momentum of EfficientNet's batch norms.
        image_mean: mean per colour that is subtracted from images in 0..1.
        image_std: standard deviation per colour that divides images in 0..1. None: that of ImageNet, or with
            ``image_weights`` that of EfficientNet's published weights.
        image_weights: file of EfficientNet's weights, such as ``model.safetensors`` of google/efficientnet-b3; None:
            random weights. Only a new run reads it.
        token_width: size of an image token.
        image_tokens: number of tokens per image, after TokenLearner.
        token_bottleneck: width of TokenLearner's hidden layer.
        width: width of the transformer and of its feed-forward layer.
        layers, heads, key_width, dropout: sizes of the transformer.
        bins: number of bins per axis of an action.
        terminate_steps: number of last actions of each episode whose terminate token is 1.
        train: see `TrainSettings`.
    """

    cameras: tuple[str, ...] = ("base_camera", "gripper_camera")
    image_size: tuple[int, int] = (320, 256)
    crop_height: int = Field(236, ge=32, le=4096)
    rate_hz: float = Field(5.0, gt=0, le=100)
    frames: int = Field(6, ge=1, le=1000)
    image_width: float = Field(1.2, gt=0)
    image_depth: float = Field(1.4, gt=0)
    drop_connect: float = Field(0.2, ge=0, lt=1)
    norm_momentum: float = Field(0.01, gt=0, le=1)
    image_mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    image_std: tuple[float, float, float] | None = None
    image_weights: Path | None = None
    token_width: int = Field(512, ge=1, le=16384)
    image_tokens: int = Field(8, ge=1, le=1000)
    token_bottleneck: int = Field(64, ge=1, le=16384)
    width: int = Field(512, ge=1, le=16384)
    layers: int = Field(8, ge=1, le=1000)
    heads: int = Field(8, ge=1, le=1024)
    key_width: int = Field(128, ge=1, le=16384)
    dropout: float = Field(0.1, ge=0, lt=1)
    bins: int = Field(256, ge=2, le=65536)
    terminate_steps: int = Field(1, ge=1, le=1000)
    train: RT1TrainSettings = RT1TrainSettings()

    @model_validator(mode="after")
    def _check(self) -> RT1Config:
        if not self.cameras or len(set(self.cameras)) < len(self.cameras):
            raise ValueError(f"cameras {list(self.cameras)}: expected at least one name, and no name twice")
        if min(self.image_size) < 32:
            raise ValueError(f"image_size {list(self.image_size)}: expected at least 32 x 32 pixels")
        if self.crop_height > self.image_size[1]:
            raise ValueError(
                f"crop_height {self.crop_height}: expected at most the {self.image_size[1]} rows of image_size"
            )
        if min(self.used_image_std) <= 0:
            raise ValueError(f"image_std {list(self.used_image_std)}: expected values above 0")
        return self

    @property
    def used_image_std(self) -> tuple[float, float, float]:
        """Return the standard deviation per colour that divides images in 0..1: ``image_std`` or its default."""
        if self.image_std is not None:
            return self.image_std
        return _IMAGENET_STD if self.image_weights is None else _KERAS_STD
