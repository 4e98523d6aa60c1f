"""The declared form of a task configuration. Metres, degrees where a name ends in ``_deg``, world frame z up."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StrictInt, model_validator

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]


class StrictModel(BaseModel):
    """Unknown keys and wrong types are errors (no silent conversion of strings); nothing changes after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class PoseConfig(StrictModel):
    """A pose in the world: position, and a turn about the vertical."""

    position: Vec3
    yaw_deg: float = 0.0


class RoomConfig(StrictModel):
    """The room: an asset of the furniture pack, standing at the world's origin."""

    asset: str
    finishes: dict[str, str] = Field(default={}, description="part (wall, floor) -> finish; others: the default")


class LightConfig(StrictModel):
    """Lights of the scene."""

    ambient: Annotated[float, Field(ge=0, le=2)] = 0.4
    directional: Annotated[float, Field(ge=0, le=10)] = 1.0
    direction: Vec3 = (0.3, 0.6, -1.0)
    shadow: bool = Field(default=False, description="doubles the cost of a frame on a CPU")


class FurnitureConfig(StrictModel):
    """A piece of furniture and where its lowest point stands."""

    asset: str
    pose: PoseConfig


class BasketConfig(FurnitureConfig):
    """The container that objects go into."""


class SurfaceConfig(StrictModel):
    """The part of a furniture surface that objects are placed on, in the furniture's frame."""

    furniture: str = Field(description="key in `furniture`")
    name: str = Field(description="surface of that furniture")
    min_xy: Vec2 | None = Field(default=None, description="none: the whole surface")
    max_xy: Vec2 | None = None

    @model_validator(mode="after")
    def _ordered(self) -> SurfaceConfig:
        if (self.min_xy is None) != (self.max_xy is None):
            raise ValueError("min_xy and max_xy go together")
        if self.min_xy and self.max_xy and not all(a < b for a, b in zip(self.min_xy, self.max_xy, strict=True)):
            raise ValueError(f"min_xy {self.min_xy} must be below max_xy {self.max_xy}")
        return self


class ScatteredLayout(StrictModel):
    """Objects apart from each other, each in a stable pose, at a random yaw."""

    kind: Literal["scattered"]
    min_gap: Annotated[float, Field(ge=0, le=0.2)] = Field(default=0.01, description="space between two objects, m")
    max_tries: Annotated[int, Field(ge=1)] = 40_000


class ObjectsConfig(StrictModel):
    """Which objects are on the surface."""

    ids: list[str | StrictInt] | Literal["all"] = Field(
        default="all", description="asset ids of the object pack, or their numbers in GraspNet-1Billion"
    )
    count: Annotated[int, Field(ge=1, le=64)] = 10


class TargetConfig(StrictModel):
    """Which of the objects may be the target."""

    min_grasps: Annotated[int, Field(ge=1)] = Field(default=20, description="fewer annotated grasps: never the target")
    min_free_grasps: Annotated[int, Field(ge=0)] = Field(
        default=6, description="fewer of them from the robot's side and clear of everything else: not the target"
    )
    max_distance: Annotated[float, Field(gt=0)] = Field(
        default=0.8, description="horizontal distance from the arm's base to the object's centre, m"
    )


class TaskConfig(StrictModel):
    """One task configuration: a file of ``task_configs/``."""

    task: Literal["pick"]
    description: str = ""
    support: str = Field(description="what the instruction calls the place the objects are on: 'table'")
    room: RoomConfig
    lights: LightConfig = LightConfig()
    furniture: dict[str, FurnitureConfig]
    basket: BasketConfig
    robot: PoseConfig = Field(description="pose of the mobile base's frame on the floor")
    surface: SurfaceConfig
    objects: ObjectsConfig = ObjectsConfig()
    layout: ScatteredLayout
    target: TargetConfig = TargetConfig()

    @model_validator(mode="after")
    def _surface_has_furniture(self) -> TaskConfig:
        if self.surface.furniture not in self.furniture:
            raise ValueError(
                f"surface.furniture: expected one of {sorted(self.furniture)}, found {self.surface.furniture!r}"
            )
        return self
