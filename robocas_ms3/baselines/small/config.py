"""How the `small` baseline sees, thinks and is trained."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, Field, model_validator

from robocas_ms3.baselines.baseline import BaselineConfig, TrainSettings
from robocas_ms3.core.strict import StrictModel


class View(StrictModel):
    """What is taken of a camera's pictures.

    Attributes:
        rendered: width and height of the pictures that are asked for, in pixels.
        part: left, top, right, bottom of the part that is looked at, in shares of the picture.
        size: width and height that this part is scaled to, in pixels; multiples of 16.
    """

    rendered: tuple[int, int] = (512, 384)
    part: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    size: tuple[int, int] = (128, 96)

    @model_validator(mode="after")
    def _check(self) -> View:
        left, top, right, bottom = self.part
        if not (0 <= left < right <= 1 and 0 <= top < bottom <= 1):
            raise ValueError(f"part {list(self.part)} is none: left < right and top < bottom, in 0..1")
        if min(self.rendered) < 16 or min(self.size) < 16 or any(number % 16 for number in self.size):
            raise ValueError("size has to be multiples of 16, and rendered at least 16 pixels")
        return self

    def box(self) -> tuple[int, int, int, int]:
        """Left, top, right, bottom of the part in pixels."""
        width, height = self.rendered
        left, top, right, bottom = self.part
        return round(left * width), round(top * height), round(right * width), round(bottom * height)


if TYPE_CHECKING:
    Views = dict[str, View]
else:  # null above a default's leaves that camera out
    Views = Annotated[dict[str, View | None], AfterValidator(lambda views: {k: v for k, v in views.items() if v})]


class SmallConfig(BaselineConfig):
    """Configuration of `small`.

    Attributes:
        views: by camera; null leaves one out. The base camera sees the room from behind the arm: what can be reached
            lies in the lower middle of its picture, objects of upstream's scenes in a thirtieth of it.
        language: whether it is told what to do.
        rate_hz: steps a second that the data has to have, and the policy acts at.
        chunk: steps it predicts.
        channels: of the first feature maps.
        width: of the transformer.
        heads, layers: of the transformer.
        dropout: of the transformer.
        keys_weight: weight of the loss of where the gripper will close or open next, beside that of the chunk.
        gripper_weight: weight of the loss of the gripper's commands.
        near: m at which a pose counts half as much as one that is reached, see `chunk_losses`; 0: all alike.
        point_weight: weight of the loss of where that is in the pictures, of each camera (`pointing`).
        name_weight: weight of the loss of where objects are that other instructions would name, of each camera.
        lift: whether what is pointed at is located by the cameras' calibration (`lifting`).
        lift_weight: weight of the loss of that, of each camera.
        shift: pixels that pictures are shifted by at most, at random, in training.
        brightness: share that brightness and contrast change by at most, at random, in training.
        play: steps of a chunk that it follows before it predicts the next one.
        fade: how fast older predictions lose weight when it acts, see `ChunkPolicy`.
        reopen: m; an empty fist that moves less between two looks opens, see `ChunkPolicy`. 0: never.
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
            raise ValueError("views of a camera at least")
        if self.width % self.heads:
            raise ValueError(f"width {self.width} has to be a multiple of heads {self.heads}")
        return self
