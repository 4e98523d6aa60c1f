"""Configuration of `small`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, Field, model_validator

from robocas_ms3.baselines.baseline import BaselineConfig, TrainSettings
from robocas_ms3.core.strict_model import StrictModel


class CameraView(StrictModel):
    """Crop and size of the images of one camera, which the network observes.

    Attributes:
        image_size: width and height of the images before the crop, pixels.
        crop: left, top, right, bottom of the crop, as fractions of the image.
        size: width and height that the crop is scaled to, pixels; multiples of 16.
    """

    image_size: tuple[int, int] = (512, 384)
    crop: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    size: tuple[int, int] = (128, 96)

    @model_validator(mode="after")
    def _check(self) -> CameraView:
        left, top, right, bottom = self.crop
        if not (0 <= left < right <= 1 and 0 <= top < bottom <= 1):
            raise ValueError(f"invalid crop {list(self.crop)}: expected left < right and top < bottom, in 0..1")
        if min(self.image_size) < 16:
            raise ValueError(f"invalid image_size {list(self.image_size)}: expected at least 16 x 16 pixels")
        if min(self.size) < 16 or any(number % 16 for number in self.size):
            raise ValueError(f"invalid size {list(self.size)}: expected multiples of 16 pixels")
        return self

    def crop_box(self) -> tuple[int, int, int, int]:
        """Return left, top, right, bottom of the crop in pixels of the image before the crop."""
        width, height = self.image_size
        left, top, right, bottom = self.crop
        return round(left * width), round(top * height), round(right * width), round(bottom * height)


if TYPE_CHECKING:
    Views = dict[str, CameraView]
else:  # null removes a camera of the defaults
    Views = Annotated[dict[str, CameraView | None], AfterValidator(lambda views: {k: v for k, v in views.items() if v})]


class SmallConfig(BaselineConfig):
    """Configuration of `small`.

    Attributes:
        views: crop and size of the images by camera name; null removes a camera. The default crop of the base camera,
            which is behind the arm, shows the reachable objects: they are in the lower middle of its images.
        language: whether the embedding of the instruction is an input.
        rate_hz: policy steps per second, of the data and of the policy.
        chunk: number of predicted policy steps.
        channels: channels of the first feature maps.
        width, heads, layers, dropout: sizes of the transformer.
        keys_weight: loss weight of the next key pose.
        gripper_weight: loss weight of the gripper commands.
        near_distance: distance in m at which the loss weight of a pose is half of its weight at 0 m, see
            `compute_chunk_losses`; 0: equal weights.
        key_cell_weight: loss weight per camera: prediction of the image cell with the next key pose (`localization`).
        object_cell_weight: loss weight per camera: prediction of the image cells with the objects, for instructions
            that name them.
        unproject: whether the network unprojects attended cells to points in space (`Unproject`). Needs the same camera
            calibration in training and evaluation.
        unproject_weight: loss weight of the unprojection per camera.
        shift: largest random image shift in training, pixels.
        brightness: largest random change of brightness and contrast in training, as a fraction.
        n_action_steps: policy steps of a chunk that are executed before the next prediction.
        temporal_ensemble_coeff: decay of the weight of older predictions per policy step, see `ChunkPolicy`.
        reopen: distance in m of the reopen heuristic, see `ChunkPolicy`; 0 switches it off.
        train: see `TrainSettings`.
    """

    views: Views = {
        "base_camera": CameraView(crop=(0.30, 0.60, 0.62, 0.90), size=(160, 112)),
        "gripper_camera": CameraView(),
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
    near_distance: float = Field(default=0.2, ge=0)
    key_cell_weight: float = Field(default=0.1, ge=0)
    object_cell_weight: float = Field(default=0.1, ge=0)
    unproject: bool = True
    unproject_weight: float = Field(default=0.1, ge=0)
    shift: int = Field(default=3, ge=0, le=1000)
    brightness: float = Field(default=0.2, ge=0, lt=1)
    n_action_steps: int = Field(default=7, ge=1, le=1000)
    temporal_ensemble_coeff: float = Field(default=0.15, ge=0)
    reopen: float = Field(default=0.02, ge=0)
    train: TrainSettings = TrainSettings(steps=3_500, batch_size=96, learning_rate=6e-4, weight_decay=0.01)

    @model_validator(mode="after")
    def _check(self) -> SmallConfig:
        if not self.views:
            raise ValueError("views: expected at least one camera, found none")
        if self.width % self.heads:
            raise ValueError(f"width {self.width}: expected a multiple of the number of heads, {self.heads}")
        return self
