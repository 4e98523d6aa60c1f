"""Models of a plan: a YAML file that describes a dataset and how to generate it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from robocas_ms3.core.checks import MAX_SEED
from robocas_ms3.core.strict_model import StrictModel
from robocas_ms3.datasets.images.image_files import ImageOptions
from robocas_ms3.datasets.lerobot.variants import NEWEST, Version
from robocas_ms3.datasets.schema import ImageFormat
from robocas_ms3.robots.cameras import STANDARD_CAMERA_NAMES

Split = Literal["train", "val"]
Stage = Literal["layouts", "demonstrations", "datasets", "statistics"]
_NEEDS = {"datasets": "demonstrations", "statistics": "datasets"}


class PartConfig(StrictModel):
    """Plan part: episodes of one task configuration, an element of `parts`."""

    task: str
    config: str | dict[str, Any] | None = Field(
        default=None,
        description="name of a bundled configuration, a YAML file next to the plan, or the configuration itself",
    )
    pack: str = "builtin"
    episodes: Annotated[int, Field(ge=1, le=1_000_000)] = Field(description="number of successful episodes")
    seed: Annotated[int, Field(ge=0, le=MAX_SEED)] = Field(
        default=0, description="first seed; the following seeds are used in order"
    )
    split: Split | None = Field(
        default=None, description="split of all episodes of the plan part; default: chosen by `split` of the plan"
    )
    name: Annotated[str, Field(pattern=r"^[\w-]+$", max_length=60)] | None = Field(
        default=None, description="name of the folders of the plan part"
    )


class RecordingConfig(StrictModel):
    """Options of `robocas generate` for all plan parts; a missing key has the default of `EpisodeSettings`."""

    planner: str | None = None
    robot: str | None = None
    max_attempts: Annotated[int, Field(ge=1, le=10_000)] | None = None
    keep_recoveries: bool | None = None
    check_rate: Annotated[int, Field(ge=0, le=100)] | None = Field(
        default=None, description="Hz; default: the rate of the dataset"
    )
    check_trials: Annotated[int, Field(ge=0, le=10_000)] | None = None
    check_failures: Annotated[int, Field(ge=0, le=10_000)] | None = None
    check_noise_mm: Annotated[float, Field(ge=0, le=1000)] | None = None
    check_noise_deg: Annotated[float, Field(ge=0, le=180)] | None = None
    record_candidates: bool | None = Field(
        default=None, description="also write `candidates.h5` next to the demonstrations"
    )
    candidates: Annotated[int, Field(ge=1, le=1000)] | None = None
    candidate_decisions: list[Literal["move", "grasp", "release", "pull"]] | None = None
    random_fraction: Annotated[float, Field(ge=0, le=1)] | None = None
    near_miss_fraction: Annotated[float, Field(ge=0, le=1)] | None = None
    candidate_depth: Annotated[int, Field(ge=0, le=20)] | None = None
    action_noise: tuple[Annotated[float, Field(ge=0, le=1000)], Annotated[float, Field(ge=0, le=180)]] | None = Field(
        default=None, description="standard deviations in mm and degrees; with noise the default of check_rate is 0"
    )


class ImagesConfig(StrictModel):
    """Size, format and cameras of the images of the dataset."""

    size: tuple[Annotated[int, Field(ge=16, le=8192)], Annotated[int, Field(ge=16, le=8192)]] = (640, 480)
    depth: bool = True
    image_format: ImageFormat = "png"
    cameras: list[str] | None = Field(
        default=None, description="names of cameras; default: all cameras of the configurations"
    )

    def image_options(self) -> ImageOptions:
        """Return the settings as `ImageOptions` for dataset writers."""
        cameras = (
            STANDARD_CAMERA_NAMES if self.cameras is None else tuple(self.cameras)
        )  # None: a plan.json of an older version
        return ImageOptions(cameras=cameras, size=self.size, depth=self.depth, image_format=self.image_format)


class LimitsConfig(StrictModel):
    """Limits of time (s) and memory per episode.

    A process that exceeds a limit is killed. Its seed is retried once, then skipped.
    """

    record_seconds: Annotated[float, Field(gt=0, le=10**7)] = 1800.0
    render_seconds: Annotated[float, Field(gt=0, le=10**7)] = 3600.0
    memory_gb: Annotated[float, Field(gt=0, le=10**5)] = Field(default=8.0, description="memory of each process, GiB")


class SplitConfig(StrictModel):
    """Rule that chooses the validation episodes of the plan parts without `split`, as `robocas split` does."""

    val_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.1
    group_by: Literal["seed", "target", "task"] = Field(
        default="seed", description="episodes with the same value stay in one split"
    )


class Plan(StrictModel):
    """Plan of a dataset; the content of its YAML file."""

    description: str = ""
    parts: Annotated[list[PartConfig], Field(min_length=1)]
    stages: Annotated[list[Stage], Field(min_length=1)] = ["demonstrations", "datasets", "statistics"]
    formats: list[Literal["robocas", "lerobot"]] = ["robocas"]
    lerobot_version: Version = Field(default=NEWEST, description="LeRobot version that reads the dataset")
    recording: RecordingConfig = RecordingConfig()
    images: ImagesConfig = ImagesConfig()
    rate: Annotated[float, Field(gt=0, le=100)] = Field(default=5.0, description="rate of the dataset, Hz")
    control_freq: Annotated[int, Field(ge=1, le=100)] = 20
    embeddings: bool = True
    split: SplitConfig | None = Field(
        default=None, description="default: as `robocas convert`, 10 % for validation, by seed"
    )
    block: Annotated[int, Field(ge=1, le=1000)] = Field(default=10, description="seeds of a work unit")
    limits: LimitsConfig = LimitsConfig()
    packs: dict[str, str] = Field(default={}, description="pack -> sha256 of its manifest when the plan was loaded")

    @field_validator("formats")
    @classmethod
    def _check_formats(cls, formats: list[str]) -> list[str]:
        if formats[:1] != ["robocas"]:
            raise ValueError(
                f"expected the first format to be robocas, found {formats}: other formats are converted from it"
            )
        return formats

    @model_validator(mode="after")
    def _check_stages(self) -> Plan:
        for stage in self.stages:
            if _NEEDS.get(stage, stage) not in self.stages:
                raise ValueError(f"stages: {stage} needs the stage {_NEEDS[stage]}; add it")
        if "lerobot" in self.formats and "datasets" not in self.stages:
            raise ValueError("formats: lerobot needs the stage datasets in stages; add it")
        tasks = {part.task for part in self.parts if part.split is None}
        if self.split and self.split.group_by == "task" and len(tasks) < 2:
            raise ValueError(
                f"split: group_by task needs plan parts of at least two tasks without `split`, found {len(tasks)}"
            )
        return self

    def part_name(self, part: int) -> str:
        """Return the folder name of a plan part, given by its index; `load_plan` sets the name."""
        return f"{self.parts[part].name}"

    def seeds_per_unit(self, part: int) -> int:
        """Return the number of seeds per work unit of a plan part: the smaller of `block` and its `episodes`."""
        return min(self.block, self.parts[part].episodes)

    def first_episode_index(self, part: int) -> int:
        """Return the index in the dataset of the first episode of a plan part."""
        return sum(other.episodes for other in self.parts[:part])
