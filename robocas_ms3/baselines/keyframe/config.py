"""Configuration of `keyframe`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from robocas_ms3.baselines.baseline import BaselineConfig, TrainSettings
from robocas_ms3.core.strict_model import StrictModel

Length = Annotated[float, Field(gt=0, le=2)]  # m
Factor = Annotated[float, Field(gt=0, le=10)]
Channels = Annotated[int, Field(ge=8, le=1024)]


class DecisionSettings(StrictModel):
    """Settings of the decisions of the policy.

    Attributes:
        view_distances: distances of the gripper camera from the point that it views, m, the preferred one first.
        close_view_distances: the same for a closer view, after no keyframe was found.
        proposals: grasps that are proposed per object.
        scored: proposals with the best heuristic score that the grasp network scores.
        target_probability: least probability of the target in a cell of its mask.
        object_probability: least probability of any object in a cell of an object.
        min_points: least number of points of an object.
    """

    view_distances: Annotated[tuple[Length, ...], Field(min_length=1)] = (0.5, 0.45, 0.55, 0.4)
    close_view_distances: Annotated[tuple[Length, ...], Field(min_length=1)] = (0.34, 0.3, 0.38, 0.42)
    proposals: int = Field(default=350, ge=1, le=10_000)
    scored: int = Field(default=96, ge=1, le=10_000)
    target_probability: float = Field(default=0.45, gt=0, lt=1)
    object_probability: float = Field(default=0.5, gt=0, lt=1)
    min_points: int = Field(default=25, ge=1)


class KeyframeConfig(BaselineConfig):
    """Configuration of `keyframe`.

    Attributes:
        image_size: width and height of the images, pixels; multiples of 32.
        crop_size: width and height of the image crops of the training, pixels; multiples of 32.
        crop_scale: least and greatest factor between the size of a crop and ``crop_size``.
        channels: channels of the segmentation network at 1/2, 1/4, 1/8, 1/16 and 1/32 of the image size.
        decoder_channels: channels of the last feature maps of the segmentation network, at 1/4 of the image size.
        grasp_channels: channels of the grasp network at its four resolutions.
        grasps: candidates per image of a training batch.
        offset_weight: loss weight of the offsets to the centres of objects.
        pull_weight: loss weight of the pulls of handles.
        grasp_weight: loss weight of the grasp network.
        text_weight: loss weight of the instruction network.
        decisions: settings of the decisions.
        train: see `TrainSettings`.
    """

    image_size: tuple[int, int] = (640, 480)
    crop_size: tuple[int, int] = (320, 256)
    crop_scale: tuple[Factor, Factor] = (0.75, 1.5)
    channels: tuple[Channels, Channels, Channels, Channels, Channels] = (24, 40, 64, 96, 128)
    decoder_channels: Channels = 56
    grasp_channels: tuple[Channels, Channels, Channels, Channels] = (24, 32, 48, 64)
    grasps: int = Field(default=4, ge=1, le=1000)
    offset_weight: float = Field(default=1.0, ge=0)
    pull_weight: float = Field(default=0.1, ge=0)
    grasp_weight: float = Field(default=1.0, ge=0)
    text_weight: float = Field(default=0.5, ge=0)
    decisions: DecisionSettings = DecisionSettings()
    train: TrainSettings = TrainSettings(
        steps=4_000,
        batch_size=12,
        learning_rate=2e-3,
        weight_decay=0.01,
        weights_precision="fp16",
        validation_samples=240,
    )

    @model_validator(mode="after")
    def _check(self) -> KeyframeConfig:
        for name, size in (("image_size", self.image_size), ("crop_size", self.crop_size)):
            if min(size) < 32 or any(length % 32 for length in size):
                raise ValueError(f"invalid {name} {list(size)}: expected multiples of 32 pixels")
        if self.crop_scale[0] > self.crop_scale[1]:
            raise ValueError(f"invalid crop_scale {list(self.crop_scale)}: expected the least factor first")
        return self
