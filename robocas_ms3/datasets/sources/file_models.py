"""Models of the JSON files of a RoboCAS folder, shared by writers, readers, checks and the viewer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeInt,
    PlainValidator,
    StringConstraints,
    ValidationError,
    model_validator,
)

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.strict_model import error_from_validation
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.files import SEE_VALIDATE
from robocas_ms3.demos.recordings.subgoals import SubGoal
from robocas_ms3.demos.recordings.trajectory_json import parse_seed
from robocas_ms3.robots.cameras import CAMERA_NAME


def _check_seed(value: Any) -> Any:
    if value is not None and parse_seed(value) is None:
        raise ValueError("an integer, or a list of one integer")
    return value


RateHz = Annotated[FiniteFloat, Field(gt=0)]
CameraName = Annotated[str, StringConstraints(pattern=f"^{CAMERA_NAME}$")]
EpisodeNumber = Annotated[str, StringConstraints(pattern=r"^[0-9]{1,7}$")]
"""Episode number as a JSON key."""
Pose = Annotated[list[FiniteFloat], Field(min_length=7, max_length=7)]


class _JsonObject(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")  # other writers may add keys


class EnvInfoRecord(_JsonObject):
    """``env_info`` in ``scene.json``: arguments of ``gym.make``."""

    env_id: str
    env_kwargs: dict[str, Any]


class LayoutRecord(_JsonObject):
    """``layout`` in ``scene.json``: the scene at the start of the episode.

    Poses are [x, y, z, qw, qx, qy, qz] in the world frame.
    """

    object_ids: list[str] = []
    poses: list[Pose] = []
    present: list[bool] = []
    robot_pose: Pose | None = None
    basket_pose: Pose | None = None
    relation: str | None = None

    @model_validator(mode="after")
    def _check_lengths(self) -> LayoutRecord:
        for values in (self.poses, self.present):
            if len(values) not in (0, len(self.object_ids)):
                raise ValueError("one pose and one value of present per object id")
        return self


class _Object(_JsonObject):
    slot: NonNegativeInt
    id: str
    name: str


class TargetRecord(_JsonObject):
    """``target`` in ``scene.json``: the object that the instruction names."""

    slot: NonNegativeInt
    asset_id: str
    name: str


class _Source(_JsonObject):
    trajectory: str | None = None
    episode_id: int | None = None
    recording: str | None = None


class _Recovery(_JsonObject):
    range: Annotated[list[int], Field(min_length=2, max_length=2)]
    stage: str
    reason: str


class RecordedDetails(_JsonObject):
    """``recorded`` in ``scene.json``: additional information of ``robocas generate``."""

    instruction_template: str | None = None
    relation: str | None = None
    support: str | None = None
    facts: dict[str, Any] | None = None
    attempts: NonNegativeInt | None = None
    recoveries: list[_Recovery] | None = None
    intervention: Any = None
    action_noise: Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)] | None = None
    seconds: dict[str, Any] | None = None


class EntryRecord(_JsonObject):
    """Entry of an episode in ``conversion.json``, see `provenance.make_recording_entry`."""

    trajectory: str | None = None
    trajectory_episode: int | None = None
    seed: Annotated[Any, PlainValidator(_check_seed)] = None
    success: bool | None = None
    recording: str | None = None


class EpisodesRecord(_JsonObject):
    """Episodes in ``conversion.json``; those in ``skipped`` could not be written and have a ``reason``."""

    made_with: dict[str, str] = {}
    episodes: dict[EpisodeNumber, EntryRecord] = {}
    skipped: dict[EpisodeNumber, EntryRecord] = {}


class SettingsRecord(_JsonObject):
    """Settings in ``conversion.json``, which apply to all episodes of a dataset."""

    rate_hz: RateHz
    cameras: Annotated[list[CameraName], Field(min_length=1)]
    image_size: Annotated[list[int], Field(min_length=2, max_length=2)] | None
    image_format: schema.ImageFormat
    depth: bool
    embeddings: bool = True


class ConversionRecord(EpisodesRecord, SettingsRecord):
    """Content of ``conversion.json``."""


_Row = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Range = Annotated[list[_Row], Field(min_length=2, max_length=2)]


class _ActionSpace(_JsonObject):
    relative_position: _Range
    relative_rotation: _Range


class DataInfoRecord(_JsonObject):
    """Content of ``data_info.json``; JSON keys that are episode numbers are strings."""

    train_eps: list[int] = Field(description="list of episode numbers")
    val_eps: list[int] = Field(description="list of episode numbers: 10 % of the seeds, at least one if there are two")
    ep_length: dict[EpisodeNumber, int] = Field(description="{number: T}")
    language_goal: dict[EpisodeNumber, str] = Field(description="{number: instruction}")
    step_goals: dict[EpisodeNumber, list[SubGoal]] = Field(
        description="{number: [{goal_type, goal_range: [first, last] step, inclusive, goal_description}]}"
    )
    action_space: _ActionSpace = Field(
        description="{relative_position: [1st percentile (3), 99th percentile (3)] of rel_pos in m,"
        " relative_rotation: these percentiles of the Euler angles of rel_orn (fixed axes x, y, z) in rad};"
        " without the last rows, which are 0 by definition"
    )


class SceneRecord(_JsonObject):
    """Content of ``scene.json``; a value is None if it is unknown, as in imported datasets."""

    schema_version: Literal[schema.SCHEMA_VERSION] = Field(  # pyright: ignore[reportInvalidTypeForm]
        description=f"{schema.SCHEMA_VERSION}"
    )
    task: str | None = Field(description="pick, select, search or open_pick")
    env_info: EnvInfoRecord | None = Field(description="{env_id, env_kwargs}: arguments of `gym.make`")
    seed: Annotated[Any, PlainValidator(_check_seed)] = Field(description="seed of `env.reset`")
    reset_options: dict[str, Any] | None = Field(description="other options of `env.reset`")
    config: dict[str, Any] | None = Field(description="the complete task configuration")
    layout: LayoutRecord | None = Field(
        description="scene at the start: {object_ids, poses, present} per slot, {robot_pose, basket_pose, relation};"
        " poses are [x, y, z, qw, qx, qy, qz] in the world"
    )
    objects: list[_Object] | None = Field(description="[{slot, id, name}] of the objects in the scene")
    target: TargetRecord | None = Field(description="{slot, asset_id, name} of the object that the instruction names")
    success: bool | None = Field(description="whether the task succeeded")
    control_mode: str | None = Field(description="control mode of the recorded actions")
    control_freq: RateHz | None = Field(description="control frequency of the recorded actions, Hz")
    rate_hz: RateHz = Field(description="rate of this dataset, Hz")
    source: _Source = Field(
        description="{trajectory, episode_id, recording: SHA-256 of seed, control mode, instruction and actions}"
    )
    recorded: RecordedDetails | None = Field(
        description="extra information of `robocas generate`: instruction template, relation, number of attempts, "
        "planning and simulation seconds, task-specific counts (`facts`, such as pushes)"
    )
    versions: dict[str, Any] | None = Field(description="{package: version} at the time of the recording")


def has_action_noise(scene: Mapping[str, Any]) -> bool:
    """Return whether noise disturbed the actions of an episode, from the content of its ``scene.json``."""
    recorded = scene.get("recorded")
    return isinstance(recorded, Mapping) and recorded.get("action_noise") is not None


SCENE_KEYS = tuple(SceneRecord.model_fields)
_UNKNOWN = {**dict.fromkeys(SCENE_KEYS), "schema_version": schema.SCHEMA_VERSION, "rate_hz": 1.0, "source": {}}


def fill_unknown_keys(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Add the missing keys of ``scene.json`` with the value None (unknown)."""
    return {**_UNKNOWN, **scene}


def read_scene(scene: Mapping[str, Any], where: object) -> SceneRecord:
    """Validate the content of ``scene.json``; raise DatasetError if it is invalid.

    Missing keys become None. ``where`` names the episode in the error.
    """
    try:
        return SceneRecord.model_validate(fill_unknown_keys(scene))
    except ValidationError as problem:
        about = "invalid content of scene.json"
        raise error_from_validation(
            problem, SceneRecord, DatasetError, where=where, about=about, fix=SEE_VALIDATE
        ) from problem
