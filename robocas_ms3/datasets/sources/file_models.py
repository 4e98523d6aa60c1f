"""Declared forms of the JSON files of a RoboCAS folder; writers, readers, checks and the viewer share them."""

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
from robocas_ms3.demos.recordings.trajectory_json import one_seed
from robocas_ms3.robots.cameras import CAMERA_NAME


def _seed(value: Any) -> Any:
    if value is not None and one_seed(value) is None:
        raise ValueError("an integer, or a list of one")
    return value


RateHz = Annotated[FiniteFloat, Field(gt=0)]
CameraName = Annotated[str, StringConstraints(pattern=f"^{CAMERA_NAME}$")]
EpisodeNumber = Annotated[str, StringConstraints(pattern=r"^[0-9]{1,7}$")]
"""A key of JSON."""
Pose = Annotated[list[FiniteFloat], Field(min_length=7, max_length=7)]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")  # further keys are their writer's


class EnvInfo(_Part):
    """``env_info``."""

    env_id: str
    env_kwargs: dict[str, Any]


class Layout(_Part):
    """``layout``: poses [x, y, z, qw, qx, qy, qz] in the world."""

    object_ids: list[str] = []
    poses: list[Pose] = []
    present: list[bool] = []
    robot_pose: Pose | None = None
    basket_pose: Pose | None = None
    relation: str | None = None

    @model_validator(mode="after")
    def _check_lengths(self) -> Layout:
        for values in (self.poses, self.present):
            if len(values) not in (0, len(self.object_ids)):
                raise ValueError("as many poses and values of present as object_ids")
        return self


class _Object(_Part):
    slot: NonNegativeInt
    id: str
    name: str


class Target(_Part):
    """``target``."""

    slot: NonNegativeInt
    asset_id: str
    name: str


class _Source(_Part):
    trajectory: str | None = None
    episode_id: int | None = None
    recording: str | None = None


class _Recovery(_Part):
    range: Annotated[list[int], Field(min_length=2, max_length=2)]
    stage: str
    reason: str


class RecordedDetails(_Part):
    """Details of the recording, the key ``recorded`` of scene.json."""

    instruction_template: str | None = None
    relation: str | None = None
    support: str | None = None
    facts: dict[str, Any] | None = None
    attempts: NonNegativeInt | None = None
    recoveries: list[_Recovery] | None = None
    intervention: Any = None
    seconds: dict[str, Any] | None = None


class EntryRecord(_Part):
    """The recording that an episode is of, in ``conversion.json``; see `provenance.recording_entry`."""

    trajectory: str | None = None
    trajectory_episode: int | None = None
    seed: Annotated[Any, PlainValidator(_seed)] = None
    success: bool | None = None
    recording: str | None = None


class EpisodesRecord(_Part):
    """The episodes of ``conversion.json``; those left out could not be written, with ``reason``."""

    made_with: dict[str, str] = {}
    episodes: dict[EpisodeNumber, EntryRecord] = {}
    skipped: dict[EpisodeNumber, EntryRecord] = {}


class SettingsRecord(_Part):
    """The settings of ``conversion.json``, which all episodes of a dataset share."""

    rate_hz: RateHz
    cameras: Annotated[list[CameraName], Field(min_length=1)]
    image_size: Annotated[list[int], Field(min_length=2, max_length=2)] | None
    image_format: schema.ImageFormat
    depth: bool
    embeddings: bool = True


class ConversionRecord(EpisodesRecord, SettingsRecord):
    """``conversion.json``."""


_Row = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Range = Annotated[list[_Row], Field(min_length=2, max_length=2)]


class _ActionSpace(_Part):
    relative_position: _Range
    relative_rotation: _Range


class DataInfoRecord(_Part):
    """``data_info.json``. JSON turns the episode numbers of ``{number: ...}`` into strings."""

    train_eps: list[int] = Field(description="list of episode numbers")
    val_eps: list[int] = Field(
        description="list of episode numbers: 10 % of the seeds, at least one where there are two"
    )
    ep_length: dict[EpisodeNumber, int] = Field(description="{number: T}")
    language_goal: dict[EpisodeNumber, str] = Field(description="{number: instruction}")
    step_goals: dict[EpisodeNumber, list[SubGoal]] = Field(
        description="{number: [{goal_type, goal_range: [first, last] step, inclusive, goal_description}]}"
    )
    action_space: _ActionSpace = Field(
        description="{relative_position: [1st percentile (3), 99th percentile (3)] of rel_pos in m,"
        " relative_rotation: the same of rel_orn as Euler xyz angles in rad}; last rows left out"
    )


class SceneRecord(_Part):
    """``scene.json``. None is what nobody knows, as of datasets made elsewhere."""

    schema_version: Literal[schema.SCHEMA_VERSION] = Field(  # pyright: ignore[reportInvalidTypeForm]
        description=f"{schema.SCHEMA_VERSION}"
    )
    task: str | None = Field(description="pick, select, search or open_pick")
    env_info: EnvInfo | None = Field(description="{env_id, env_kwargs}: what makes the environment")
    seed: Annotated[Any, PlainValidator(_seed)] = Field(description="of `env.reset`")
    reset_options: dict[str, Any] | None = Field(description="further options of `env.reset`")
    config: dict[str, Any] | None = Field(description="the whole configuration")
    layout: Layout | None = Field(
        description="{object_ids, poses [x, y, z, qw, qx, qy, qz] in the world, present, robot_pose, basket_pose,"
        " relation}"
    )
    objects: list[_Object] | None = Field(description="[{slot, id, name}] those that take part")
    target: Target | None = Field(description="{slot, asset_id, name}")
    success: bool | None = Field(description="whether the recording ended in success")
    control_mode: str | None = Field(description="of the recorded actions")
    control_freq: RateHz | None = Field(description="of the recorded actions, Hz")
    rate_hz: RateHz = Field(description="of this dataset")
    source: _Source = Field(
        description="{trajectory, episode_id, recording: SHA-256 of seed, control mode, instruction and actions}"
    )
    recorded: RecordedDetails | None = Field(
        description="what the generator said of the episode: template, relation, facts, attempts, seconds"
    )
    versions: dict[str, Any] | None = Field(description="{package: version} the episode was generated with")


SCENE_KEYS = tuple(SceneRecord.model_fields)
_UNKNOWN = {**dict.fromkeys(SCENE_KEYS), "schema_version": schema.SCHEMA_VERSION, "rate_hz": 1.0, "source": {}}


def fill_unknown_keys(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of ``scene.json`` with the keys that an older or foreign file lacks."""
    return {**_UNKNOWN, **scene}


def read_scene(scene: Mapping[str, Any], where: object) -> SceneRecord:
    """Return the content of ``scene.json`` as a record, or raise DatasetError; keys may be missing."""
    try:
        return SceneRecord.model_validate(fill_unknown_keys(scene))
    except ValidationError as problem:
        about = "this description of a scene is damaged"
        raise error_from_validation(
            problem, SceneRecord, DatasetError, where=where, about=about, fix=SEE_VALIDATE
        ) from problem
