"""Configuration of `small`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, Field, model_validator

from robocas_ms3.baselines.baseline import BaselineConfig, TrainSettings
from robocas_ms3.core.strict_model import StrictModel


class View(StrictModel):
    """The part of a camera's images that the network sees.

    Attributes:
        rendered: width and height of the whole images, in pixels.
        part: left, top, right, bottom of the part, as fractions of the image.
        size: width and height that the part is scaled to, in pixels; multiples of 16.
    """

    rendered: tuple[int, int] = (512, 384)
    part: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    size: tuple[int, int] = (128, 96)

    @model_validator(mode="after")
    def _check(self) -> View:
        left, top, right, bottom = self.part
        if not (0 <= left < right <= 1 and 0 <= top < bottom <= 1):
            raise ValueError(f"invalid part {list(self.part)}: expected left < right and top < bottom, in 0..1")
        if min(self.rendered) < 16 or min(self.size) < 16 or any(number % 16 for number in self.size):
            raise ValueError("size has to be multiples of 16, and rendered at least 16 pixels")
        return self

    def box(self) -> tuple[int, int, int, int]:
        """Return left, top, right, bottom of the part in pixels."""
        width, height = self.rendered
        left, top, right, bottom = self.part
        return round(left * width), round(top * height), round(right * width), round(bottom * height)


if TYPE_CHECKING:
    Views = dict[str, View]
else:  # null leaves a camera of the defaults out
    Views = Annotated[dict[str, View | None], AfterValidator(lambda views: {k: v for k, v in views.items() if v})]


class SmallConfig(BaselineConfig):
    """Configuration of `small`.

    Attributes:
        views: by camera; null leaves one out. The base camera is behind the arm: what can be reached is in the lower
            middle of its images, objects of RoboCAS-v0's scenes in a thirtieth of them.
        language: whether the instruction is an input.
        rate_hz: steps per second of the data and of the policy.
        chunk: number of predicted steps.
        channels: of the first feature maps.
        width, heads, layers, dropout: of the transformer.
        keys_weight: weight of the loss of the next key pose.
        gripper_weight: weight of the loss of the gripper commands.
        near: distance in m at which a pose has half the weight of one that is reached, see `chunk_losses`; 0: no
            weights.
        point_weight: weight, per camera, of the loss of where the next key pose is in the image (`localization`).
        name_weight: weight, per camera, of the loss of where objects of other instructions are.
        lift: whether points are located in space by the calibration of the cameras (`localization.Lift`).
        lift_weight: weight of the loss of that, per camera.
        shift: largest random shift of the images in training, in pixels.
        brightness: largest random change of brightness and contrast in training, as a fraction.
        play: steps of a chunk before the next one is predicted.
        fade: decay of the weight of older predictions, see `ChunkPolicy`.
        reopen: distance in m of the reopen heuristic, see `ChunkPolicy`; 0: switched off.
        train: see `TrainSettings`.
    """

    views: Views = {
        "base_camera": View(part=(0.30, 0.60, 0.62, 0.90), size=(160, 112)),
        "gripper_camera": View(),
    }
    language: bool = True
    rate_hz: float = Field(default=5.0, gt=0, le=100)
    chunk: int = Field(default=8, ge=1, le=1000)
    channels: int = Field(default=32, ge=8, multiple_of=8, le=4096)
    width: int = Field(default=128, ge=8, le=16384)
    heads: int = Field(default=4, ge=1, le=1024)
    layers: int = Field(default=3, ge=1, le=1000)
    dropout: float = Field(default=0.1, ge=0, lt=1)
    keys_weight: float = Field(default=0.5, ge=0)
    gripper_weight: float = Field(default=0.5, ge=0)
    near: float = Field(default=0.2, ge=0)
    point_weight: float = Field(default=0.1, ge=0)
    name_weight: float = Field(default=0.1, ge=0)
    lift: bool = True
    lift_weight: float = Field(default=0.1, ge=0)
    shift: int = Field(default=3, ge=0, le=1000)
    brightness: float = Field(default=0.2, ge=0, lt=1)
    play: int = Field(default=7, ge=1, le=1000)
    fade: float = Field(default=0.15, ge=0)
    reopen: float = Field(default=0.02, ge=0)
    train: TrainSettings = TrainSettings(steps=3_500, batch_size=96, learning_rate=6e-4, weight_decay=0.01)

    @model_validator(mode="after")
    def _check(self) -> SmallConfig:
        if not self.views:
            raise ValueError("views have to be of at least one camera")
        if self.width % self.heads:
            raise ValueError(f"width {self.width} has to be a multiple of heads {self.heads}")
        return self
