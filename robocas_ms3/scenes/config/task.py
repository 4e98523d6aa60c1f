"""The declared form of a task configuration. Metres, degrees where a name ends in ``_deg``, world frame z up."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, StrictInt, model_validator

from robocas_ms3.core.errors import ConfigError, ExtensionError
from robocas_ms3.core.extensions import load_object
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
        raise ValueError("a direction is not the zero vector")
    return vector


Direction = Annotated[Vec3, AfterValidator(_check_direction)]


class PoseConfig(StrictModel):
    """A pose in the world: position, and a turn about the vertical."""

    position: Vec3 = Field(description="x, y, z, m")
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] = Field(
        default=0.0, description="counter-clockwise, seen from above"
    )


class RoomConfig(StrictModel):
    """The room: an asset of the furniture pack, standing at the world's origin."""

    asset: str = Field(description="id in the furniture pack")
    finishes: dict[str, str] = Field(default={}, description="part (wall, floor) -> finish; others: the default")


class LightConfig(StrictModel):
    """Lights of the scene."""

    ambient: Annotated[float, Field(ge=0, le=2)] = Field(default=0.4, description="light from everywhere")
    directional: Annotated[float, Field(ge=0, le=10)] = Field(default=1.0, description="light from one direction")
    direction: Direction = Field(default=(0.3, 0.6, -1.0), description="along which that light shines")
    shadow: bool = Field(default=False, description="doubles the cost of a frame on a CPU")


class PlacedConfig(StrictModel):
    """An asset and where its lowest point stands."""

    asset: str = Field(description="id in the furniture pack, or pack/id")
    pose: PoseConfig


class FurnitureConfig(PlacedConfig):
    """A piece of furniture."""

    joints: dict[str, Coordinate] = Field(
        default={}, description="where doors and drawers stand at first, m or rad; else 0"
    )


class BasketConfig(PlacedConfig):
    """The container that objects go into."""


class SurfaceConfig(StrictModel):
    """The part of a furniture surface that objects are placed on, in the furniture's frame."""

    furniture: str = Field(description="key in `furniture`")
    name: str = Field(description="surface of that furniture")
    min_xy: Vec2 | None = Field(default=None, description="a corner of the part, m; none: the whole surface")
    max_xy: Vec2 | None = Field(default=None, description="the corner opposite to min_xy, m")

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
    max_tries: Annotated[int, Field(ge=1, le=10**7)] = Field(
        default=40_000, description="poses drawn before a seed is given up"
    )


class OrderlyLayout(StrictModel):
    """Objects of a kind one behind the other from the front edge, kinds side by side, standing, labels to the front."""

    kind: Literal["orderly"]
    copies: Annotated[int, Field(ge=1, le=8)] = Field(default=2, description="objects of each kind")
    rows: Annotated[int, Field(ge=1, le=8)] = Field(
        default=2, description="objects in a column; further copies begin another column"
    )
    row_gap: Annotated[float, Field(ge=0, le=0.2)] = Field(default=0.01, description="space within a column, m")
    column_spacing: Annotated[float, Field(ge=1, le=4)] = Field(
        default=1.3, description="distance of neighbouring columns as a multiple of their width"
    )
    yaw_jitter_deg: Annotated[float, Field(ge=0, le=45)] = Field(default=0.0, description="greatest turn of an object")
    column_yaw: Literal["front", "random"] = Field(
        default="front", description="random: each column is turned by any angle, the same for its objects (upstream's)"
    )
    keep_what_fits: bool = Field(
        default=False,
        description="leave out columns that don't fit, and objects too far back (upstream's); else draw others",
    )


class StackedLayout(StrictModel):
    """A heap: objects dropped one by one into a bounded region, whose walls are then taken away."""

    kind: Literal["stacked"]
    drop_height: Annotated[float, Field(gt=0, le=1)] = Field(default=0.3, description="above the surface or heap, m")
    tumble_probability: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.6, description="of an object falling in any orientation; else in a stable pose at a random yaw"
    )
    bucket: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.8, description="sides of the walls as a share of the region's; narrow ones bury more (upstream: 1)"
    )
    drop_spread: Annotated[float, Field(ge=0, le=1)] = Field(
        default=1.0,
        description="share of the room between the walls that objects fall into; 0: its middle (upstream's)",
    )
    order_noise: Annotated[float, Field(ge=0)] | None = Field(
        default=0.5,
        description="small objects rather fall first: deviation of the logarithm of their sizes; null: in any order "
        "(upstream's)",
    )
    fall_seconds: Annotated[float, Field(gt=0, le=5)] = Field(
        default=0.5, description="until the next object falls; one takes 0.25 to land (upstream: 1)"
    )


LayoutConfig = Annotated[ScatteredLayout | OrderlyLayout | StackedLayout, Field(discriminator="kind")]


class ObjectsConfig(StrictModel):
    """Which objects are on the surface."""

    ids: list[str | StrictInt] | Literal["all"] = Field(
        default="all", description="asset ids of the object pack, or their numbers in GraspNet-1Billion"
    )
    count: Annotated[int, Field(ge=1, le=64)] = Field(default=10, description="how many of them")
    repeats: bool = Field(
        default=False, description="draw an object, or a kind of columns, more than once; else only if ids are too few"
    )


class TargetConfig(StrictModel):
    """Which of the objects may be the target."""

    min_grasps: Annotated[int, Field(ge=0)] = Field(default=20, description="fewer annotated grasps: never the target")
    min_free_grasps: Annotated[int, Field(ge=0)] = Field(
        default=6, description="fewer of them from the robot's side and clear of everything else: not the target"
    )
    max_distance: Annotated[float, Field(gt=0)] = Field(
        default=0.8, description="horizontal distance from the arm's base to the object's centre, m"
    )
    approach: Literal["top", "front"] = Field(
        default="top", description="top: from above; front: level, as into a shelf"
    )
    relations: list[Relation] = Field(
        default=list(RELATIONS),
        description="select: how the target is told apart; default: all that its copies allow; []: it is not, the "
        "nearest of its name is meant (upstream's)",
    )
    max_visible_share: Annotated[float, Field(gt=0, le=1)] | None = Field(
        default=0.9, description="search: the target's p_vis from above is lower; null: it may lie open"
    )
    weight: Literal["nearness", "uniform"] = Field(
        default="nearness", description="search: near ones are drawn more often, 1 / distance; or all alike"
    )
    min_uncovered_grasps: Annotated[int, Field(ge=0)] = Field(
        default=6,
        description="search: fewer of its grasps, as it lies, clear of furniture and basket: not the target",
    )


class OpeningConfig(StrictModel):
    """The door or drawer to open first."""

    furniture: str = Field(description="key in `furniture`")
    handle: str = Field(description="handle of that furniture")
    part: str = Field(default="", description="what instructions call the part; default: from the handle's name")
    opened_at: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.6,
        description="share of the joint's range from which it counts as opened, below 0.8 (hinge) or 0.95 (slide)",
    )


class LanguageConfig(StrictModel):
    """The words of instructions."""

    split: Literal["upstream", "train", "held_out"] = Field(
        default="upstream", description="upstream: its one template; train, held_out: one of many, drawn by the seed"
    )
    synonyms: bool = Field(default=True, description="with train or held_out: also call things by their synonyms")


class TaskConfig(StrictModel):
    """One task configuration: a file of ``task_configs/``."""

    task: str = Field(description="which task; see tasks.md", json_schema_extra={"enum": list(TASKS.builtin)})
    description: str = Field(default="", description="one line for `robocas list`")
    support: str = Field(description="what the instruction calls the place the objects are on: 'table'")
    room: RoomConfig
    lights: LightConfig = LightConfig()
    furniture: dict[str, FurnitureConfig]
    basket: BasketConfig | None = Field(
        default=None, description="the container that objects go into; the benchmark's own tasks need it"
    )
    robot: PoseConfig = Field(description="pose of the mobile base's frame on the floor")
    robot_start: Literal["rest", "evaluation"] = Field(
        default="rest",
        description="the arm at the beginning: folded, or above the table as upstream's evaluation starts",
    )
    surface: SurfaceConfig
    objects: ObjectsConfig = ObjectsConfig()
    layout: LayoutConfig
    target: TargetConfig = TargetConfig()
    opening: OpeningConfig | None = Field(default=None, description="open_pick: what is opened")
    language: LanguageConfig = LanguageConfig()
    static_camera: Literal["upstream", "overview"] = Field(
        default="upstream",
        description="upstream: at (1, 1.5, 1.5), which looks at a table; overview: from aside, wherever the task is",
    )
    cameras: CamerasConfig = Field(
        default={},
        exclude_if=lambda cameras: not cameras,  # files of configurations without stay as they are
        description="changes of the robot's cameras, and further cameras",
    )
    base_motion: bool = Field(default=False, description="scripted policies may drive the base; actions then hold it")
    randomisation: RandomisationConfig = RandomisationConfig()

    @model_validator(mode="after")
    def _parts_fit(self) -> TaskConfig:
        for name, part in (("surface", self.surface), ("opening", self.opening)):
            if part is not None and part.furniture not in self.furniture:
                raise ValueError(
                    f"{name}.furniture: expected one of {sorted(self.furniture)}, found {part.furniture!r}"
                )
        try:
            spec = TASKS.find(self.task)
        except ExtensionError as error:
            told = ConfigError("wrong value for 'task'", expected=error.expected, found=error.found, fix=error.fix)
            raise ValueError(str(told)) from error
        if (self.opening is not None) != ("part" in spec.slots):
            those = ", ".join(name for name, other in TASKS.items() if "part" in other.slots)
            raise ValueError(f"`opening` goes with task {those}, and only with it")
        if self.randomisation.basket is not None and self.basket is None:
            raise ValueError("randomisation.basket: there is no `basket` to move")
        for check in spec.checks:
            load_object(check)(self)
        undrawn = sorted(set(self.randomisation.finishes) - set(self.randomisation.room or ()))
        if undrawn:
            raise ValueError(f"randomisation.finishes: {undrawn} must be among randomisation.room")
        count = self.randomisation.count
        if count is not None and not count[0] <= count[1] <= self.objects.count:
            raise ValueError(
                f"randomisation.count {list(count)} must rise and end at objects.count {self.objects.count}"
            )
        return self

    def cameras_of(self, robot: RobotDescription) -> tuple[CameraSpec, ...]:
        """Return the cameras of a robot in this task.

        Raises:
            ConfigError: a camera that the robot does not have is not placed.
        """
        overview = [("static_camera", CameraConfig(overview=True))] if self.static_camera == "overview" else []
        return apply_camera_changes(robot.cameras, [*overview, *self.cameras.items()])

    @property
    def has_unused_slots(self) -> bool:
        """Whether an episode may use fewer objects than there are slots."""
        random, layout = self.randomisation, self.layout
        kept = isinstance(layout, OrderlyLayout) and layout.keep_what_fits
        return kept or bool(random.count or random.distractors)


def require_basket(config: TaskConfig) -> None:
    """Raise ValueError where there is no basket; a task names this function in its ``checks``."""
    if config.basket is None:
        raise ValueError(f"task {config.task} needs a `basket`")


def require_copies(config: TaskConfig) -> None:
    """Raise ValueError where there are no several objects of a kind, in rows; see `require_basket`."""
    if not (isinstance(config.layout, OrderlyLayout) and config.layout.copies > 1):
        raise ValueError(f"task {config.task} needs layout.kind orderly with layout.copies > 1")
