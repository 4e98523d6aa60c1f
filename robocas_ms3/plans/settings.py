"""What a plan says of its parts, of recording, pictures, limits and the split."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from robocas_ms3.core.strict import StrictModel
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.demos.recordings.seeds import GREATEST_SEED

Side = Literal["train", "val"]


class PartConfig(StrictModel):
    """Episodes of one configuration."""

    task: str
    config: str | dict[str, Any] | None = Field(
        default=None, description="a shipped configuration, a YAML file beside the plan, or the whole of one"
    )
    pack: str = "builtin"
    episodes: Annotated[int, Field(ge=1, le=1_000_000)] = Field(description="successful ones")
    seed: Annotated[int, Field(ge=0, le=GREATEST_SEED)] = Field(default=0, description="the first; others follow")
    split: Side | None = Field(default=None, description="side of all of its episodes; default: by the plan's rule")
    name: Annotated[str, Field(pattern=r"^[\w-]+$", max_length=60)] | None = Field(
        default=None, description="of its folders"
    )


class RecordingConfig(StrictModel):
    """How episodes are recorded, where that is not as `robocas generate` does; see ``demos.EpisodeSettings``."""

    planner: str | None = None
    robot: str | None = None
    max_attempts: Annotated[int, Field(ge=1, le=10_000)] | None = None
    keep_recoveries: bool | None = None
    replay_rate: Annotated[int, Field(ge=0, le=100)] | None = Field(
        default=None, description="Hz; default: the dataset's rate"
    )
    noisy_trials: Annotated[int, Field(ge=0, le=10_000)] | None = None
    noisy_failures: Annotated[int, Field(ge=0, le=10_000)] | None = None
    noise_mm: Annotated[float, Field(ge=0, le=1000)] | None = None
    noise_deg: Annotated[float, Field(ge=0, le=180)] | None = None

    def chosen(self) -> dict[str, Any]:
        """What was said."""
        return self.model_dump(exclude_none=True)


class PicturesConfig(StrictModel):
    """What is rendered."""

    size: tuple[Annotated[int, Field(ge=16, le=8192)], Annotated[int, Field(ge=16, le=8192)]] = (640, 480)
    depth: bool = True
    image_format: Literal["png", "jpg", "webp"] = "png"
    cameras: list[str] | None = None

    def chosen(self) -> Pictures:
        """For writers of datasets."""
        cameras = Pictures.cameras if self.cameras is None else tuple(self.cameras)
        return Pictures(cameras=cameras, size=self.size, depth=self.depth, image_format=self.image_format)


class LimitsConfig(StrictModel):
    """What an episode may take; beyond it, its process is ended, and it is tried once more."""

    record_seconds: Annotated[float, Field(gt=0, le=10**7)] = 1800.0
    render_seconds: Annotated[float, Field(gt=0, le=10**7)] = 3600.0
    memory_gb: Annotated[float, Field(gt=0, le=10**5)] = Field(default=8.0, description="of each process")


class SplitConfig(StrictModel):
    """Which episodes validate, of the parts that don't say it, as `robocas split` has it."""

    val_share: Annotated[float, Field(gt=0, lt=1)] = 0.1
    by: Literal["seed", "target", "task"] = Field(default="seed", description="what stays on one side")
