"""Models of a task configuration. Lengths in m, angles of ``_deg`` keys in degrees, world z up."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, StrictInt, model_validator

from robocas_ms3.core.errors import ConfigError, ExtensionError
from robocas_ms3.core.extensions import import_object
from robocas_ms3.core.strict_model import StrictModel
from robocas_ms3.robots.cameras import CameraSpec
from robocas_ms3.robots.description import RobotDescription
from robocas_ms3.scenes.config.cameras import CameraConfig, CamerasConfig, apply_camera_changes
from robocas_ms3.scenes.config.randomisation import RandomisationConfig
from robocas_ms3.scenes.relations import RELATIONS, Relation
from robocas_ms3.scenes.task_specs import TASKS

Coordinate = Annotated[float, Field(ge=-100, le=100)]
Vec2 = tuple[Coordinate, Coordinate]
Vec3 = tuple[Coordinate, Coordinate, Coordinate]


def _check_direction(vector: Vec3) -> Vec3:
    if not any(vector):
        raise ValueError("expected a direction, found the zero vector")
    return vector


Direction = Annotated[Vec3, AfterValidator(_check_direction)]


class PoseConfig(StrictModel):
    """A pose in the world: a position and a yaw angle."""

    position: Vec3 = Field(description="x, y, z, m")
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] = Field(
        default=0.0, description="rotation about the vertical, counter-clockwise seen from above"
    )


class RoomConfig(StrictModel):
    """The room: an asset of the furniture pack at the world's origin."""

    asset: str = Field(description="id in the furniture pack")
    finishes: dict[str, str] = Field(
        default={}, description="part (wall, floor) -> finish; other parts have their default"
    )


class LightConfig(StrictModel):
    """Lights of the scene."""

    ambient: Annotated[float, Field(ge=0, le=2)] = Field(default=0.4, description="intensity of the ambient light")
    directional: Annotated[float, Field(ge=0, le=10)] = Field(
        default=1.0, description="intensity of the directional lights"
    )
    direction: Direction = Field(default=(0.3, 0.6, -1.0), description="direction of the slanted light")
    shadow: bool = Field(
        default=False, description="whether the slanted light casts shadows; doubles the rendering time on a CPU"
    )


class PlacedConfig(StrictModel):
    """An asset and the pose of its lowest point."""

    asset: str = Field(description="id in the furniture pack, or pack/id")
    pose: PoseConfig


class FurnitureConfig(PlacedConfig):
    """A piece of furniture."""

    joints: dict[str, Coordinate] = Field(
        default={}, description="start positions of doors and drawers, m or rad; others are 0 (closed)"
    )


class BasketConfig(PlacedConfig):
    """The container into which objects are put."""


class SurfaceConfig(StrictModel):
    """The rectangle of a furniture surface on which objects are placed, in the furniture's frame."""

    furniture: str = Field(description="name of the piece of furniture in `furniture`")
    name: str = Field(description="name of the surface of this piece of furniture")
    min_xy: Vec2 | None = Field(default=None, description="least corner of the rectangle, m; none: the whole surface")
    max_xy: Vec2 | None = Field(default=None, description="greatest corner of the rectangle, m")

    @model_validator(mode="after")
    def _check_corners(self) -> SurfaceConfig:
        if (self.min_xy is None) != (self.max_xy is None):
            raise ValueError("expected both min_xy and max_xy, or neither")
        if self.min_xy and self.max_xy and not all(a < b for a, b in zip(self.min_xy, self.max_xy, strict=True)):
            raise ValueError(f"min_xy {self.min_xy}: expected both components less than those of max_xy {self.max_xy}")
        return self


class ScatteredLayout(StrictModel):
    """Objects that don't touch each other, each in a stable pose at a random yaw."""

    kind: Literal["scattered"]
    min_gap: Annotated[float, Field(ge=0, le=0.2)] = Field(
        default=0.01, description="least distance between two objects, m"
    )
    max_tries: Annotated[int, Field(ge=1, le=10**7)] = Field(
        default=40_000, description="number of drawn poses after which a seed has no layout"
    )


class OrderlyLayout(StrictModel):
    """Upright objects in columns that start at the front edge, one kind per column, labels to the front."""

    kind: Literal["orderly"]
    copies: Annotated[int, Field(ge=1, le=8)] = Field(default=2, description="objects of each kind")
    rows: Annotated[int, Field(ge=1, le=8)] = Field(
        default=2, description="objects in a column; more copies start another column"
    )
    row_gap: Annotated[float, Field(ge=0, le=0.2)] = Field(
        default=0.01, description="distance between the objects of a column, m"
    )
    column_spacing: Annotated[float, Field(ge=1, le=4)] = Field(
        default=1.3, description="distance of neighbouring columns as a multiple of their mean width"
    )
    yaw_jitter_deg: Annotated[float, Field(ge=0, le=45)] = Field(
        default=0.0, description="greatest random turn of an object"
    )
    column_yaw: Literal["front", "random"] = Field(
        default="front", description="random: all objects of a column are turned by one random angle (RoboCAS-v0)"
    )
    keep_what_fits: bool = Field(
        default=False,
        description="whether columns and objects that don't fit are omitted (RoboCAS-v0); false: other kinds are drawn",
    )


class StackedLayout(StrictModel):
    """A heap: objects drop one by one between four walls, which are then removed."""

    kind: Literal["stacked"]
    drop_height: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.3, description="height of the drop above the surface or heap, m"
    )
    tumble_probability: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.6, description="probability that an object falls in a random orientation instead of a stable pose"
    )
    bucket: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.8,
        description="size of the walled area as a fraction of the region; less hides more objects (RoboCAS-v0: 1)",
    )
    drop_spread: Annotated[float, Field(ge=0, le=1)] = Field(
        default=1.0,
        description="fraction of the walled area into which objects fall; 0: its middle (RoboCAS-v0)",
    )
    order_noise: Annotated[float, Field(ge=0)] | None = Field(
        default=0.5,
        description="small objects fall first: standard deviation of the noise on the logarithm of their sizes; null: "
        "random order (RoboCAS-v0)",
    )
    fall_seconds: Annotated[float, Field(gt=0, le=5)] = Field(
        default=0.5, description="time between two objects, s; an object lands after 0.25 s (RoboCAS-v0: 1)"
    )


LayoutConfig = Annotated[ScatteredLayout | OrderlyLayout | StackedLayout, Field(discriminator="kind")]


class ObjectsConfig(StrictModel):
    """Which objects are on the surface."""

    ids: list[str | StrictInt] | Literal["all"] = Field(
        default="all", description="ids of the object pack, or numbers in GraspNet-1Billion"
    )
    count: Annotated[int, Field(ge=1, le=64)] = Field(default=10, description="number of objects")
    repeats: bool = Field(
        default=False,
        description="whether an object (or a kind of columns) may be drawn repeatedly even if there are enough ids",
    )


class TargetConfig(StrictModel):
    """Which objects may be the target."""

    min_grasps: Annotated[int, Field(ge=0)] = Field(default=20, description="least number of annotated grasps")
    min_free_grasps: Annotated[int, Field(ge=0)] = Field(
        default=6, description="least number of grasps from the robot's side that are free of collisions"
    )
    max_distance: Annotated[float, Field(gt=0)] = Field(
        default=0.8, description="greatest horizontal distance from the arm's base to the object's centre, m"
    )
    approach: Literal["top", "front"] = Field(
        default="top", description="top: from above; front: horizontal, as into a shelf"
    )
    relations: list[Relation] = Field(
        default=list(RELATIONS),
        description="select: relations that may distinguish the target; default: all that the copies allow; []: none, "
        "the nearest object of its name is the target (RoboCAS-v0)",
    )
    max_visible_share: Annotated[float, Field(gt=0, le=1)] | None = Field(
        default=0.9, description="search: upper limit of the target's visible fraction p_vis from above; null: no limit"
    )
    weight: Literal["nearness", "uniform"] = Field(
        default="nearness", description="search: weight of a candidate: 1 / distance to the robot, or equal weights"
    )
    min_uncovered_grasps: Annotated[int, Field(ge=0)] = Field(
        default=6,
        description="search: least number of grasps in its pose that are clear of furniture and basket",
    )


class OpeningConfig(StrictModel):
    """The door or drawer that must be opened."""

    furniture: str = Field(description="name of the piece of furniture in `furniture`")
    handle: str = Field(description="name of the handle of this piece of furniture")
    part: str = Field(default="", description="name of the part in instructions; default: from the handle's name")
    opened_at: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.6,
        description="fraction of the joint's range from which it counts as open, below 0.8 (hinge) or 0.95 (slide)",
    )


class LanguageConfig(StrictModel):
    """Templates and words of instructions."""

    split: Literal["upstream", "train", "held_out"] = Field(
        default="upstream", description="upstream: RoboCAS-v0's template; train, held_out: a random template of the set"
    )
    synonyms: bool = Field(
        default=True, description="whether templates of train and held_out are filled with synonyms too"
    )


class TaskConfig(StrictModel):
    """One task configuration: a file of ``task_configs/``."""

    task: str = Field(description="name of the task; see tasks.md", json_schema_extra={"enum": list(TASKS.builtin)})
    description: str = Field(default="", description="one line for `robocas list`")
    support: str = Field(description="word of the instruction for the place of the objects, e.g. 'table'")
    room: RoomConfig
    lights: LightConfig = LightConfig()
    furniture: dict[str, FurnitureConfig]
    basket: BasketConfig | None = Field(
        default=None, description="the container into which objects are put; required by the four bundled tasks"
    )
    robot: PoseConfig = Field(description="pose of the mobile base's frame on the floor")
    robot_start: Literal["rest", "evaluation"] = Field(
        default="rest",
        description="start pose of the arm: folded, or above the table as in RoboCAS-v0's evaluation",
    )
    surface: SurfaceConfig
    objects: ObjectsConfig = ObjectsConfig()
    layout: LayoutConfig
    target: TargetConfig = TargetConfig()
    opening: OpeningConfig | None = Field(default=None, description="open_pick: the door or drawer to open")
    language: LanguageConfig = LanguageConfig()
    static_camera: Literal["upstream", "overview"] = Field(
        default="upstream",
        description="upstream: at (1, 1.5, 1.5) as in RoboCAS-v0, for a table; overview: next to the scene, anywhere",
    )
    cameras: CamerasConfig = Field(
        default={},
        exclude_if=lambda cameras: not cameras,  # configurations without the key stay unchanged
        description="changes of the robot's cameras, and additional cameras",
    )
    base_motion: bool = Field(
        default=False, description="whether scripted policies may drive the base; recorded actions then include it"
    )
    randomisation: RandomisationConfig = RandomisationConfig()

    @model_validator(mode="after")
    def _check_references(self) -> TaskConfig:
        for name, part in (("surface", self.surface), ("opening", self.opening)):
            if part is not None and part.furniture not in self.furniture:
                raise ValueError(
                    f"{name}.furniture: expected one of {sorted(self.furniture)}, found {part.furniture!r}"
                )
        try:
            spec = TASKS.find(self.task)
        except ExtensionError as error:
            invalid = ConfigError("invalid value for 'task'", expected=error.expected, found=error.found, fix=error.fix)
            raise ValueError(str(invalid)) from error
        if (self.opening is not None) != ("part" in spec.slots):
            those = ", ".join(name for name, other in TASKS.items() if "part" in other.slots)
            raise ValueError(f"`opening` is required for the task {those} and not allowed for other tasks")
        if self.randomisation.basket is not None and self.basket is None:
            raise ValueError("randomisation.basket requires a `basket`")
        for check in spec.checks:
            import_object(check)(self)
        undrawn = sorted(set(self.randomisation.finishes) - set(self.randomisation.room or ()))
        if undrawn:
            raise ValueError(f"randomisation.finishes: {undrawn} must be among randomisation.room")
        count = self.randomisation.count
        if count is not None and not count[0] <= count[1] <= self.objects.count:
            raise ValueError(
                f"randomisation.count {list(count)} must be a range [least, greatest] up to objects.count "
                f"{self.objects.count}"
            )
        return self

    def cameras_of(self, robot: RobotDescription) -> tuple[CameraSpec, ...]:
        """Return the cameras of a robot with the changes of this configuration.

        Raises:
            ConfigError: an additional camera has no position.
        """
        overview = [("static_camera", CameraConfig(overview=True))] if self.static_camera == "overview" else []
        return apply_camera_changes(robot.cameras, [*overview, *self.cameras.items()])

    @property
    def has_unused_slots(self) -> bool:
        """Whether an episode may use fewer objects than the number of slots."""
        random, layout = self.randomisation, self.layout
        kept = isinstance(layout, OrderlyLayout) and layout.keep_what_fits
        return kept or bool(random.count or random.distractors)


def require_basket(config: TaskConfig) -> None:
    """Raise ValueError if a configuration has no basket; for the ``checks`` of a task."""
    if config.basket is None:
        raise ValueError(f"task {config.task} needs a `basket`")


def require_copies(config: TaskConfig) -> None:
    """Raise ValueError if no kind has several objects in columns; see `require_basket`."""
    if not (isinstance(config.layout, OrderlyLayout) and config.layout.copies > 1):
        raise ValueError(f"task {config.task} needs layout.kind orderly with layout.copies > 1")
