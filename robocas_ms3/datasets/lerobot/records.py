"""Declared forms of a LeRobot dataset's JSON files and tables; reader and checker share them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, StringConstraints, model_validator

from robocas_ms3.datasets.lerobot import schema
from robocas_ms3.datasets.lerobot.tables import INTEGER, INTEGERS, NUMBER, NUMBERS, TEXT, TEXTS, Column, Kind
from robocas_ms3.datasets.sources.provenance import EntryRecord

MAX_EPISODES = 10**6
MAX_FRAMES = 10**9
_MAX_FILES = 10**6
_MAX_SECONDS = 1e6  # of a video's timestamps

Name = Annotated[str, StringConstraints(pattern=r"^[^\x00-\x1f\x7f/\\.][^\x00-\x1f\x7f/\\]*$", max_length=200)]
"""A feature's key: it is part of paths, so LeRobot too refuses one with a slash."""
Dtype = Annotated[
    str, StringConstraints(pattern=r"^(video|image|string|bool|float(16|32|64)|u?int(8|16|32|64))$")
]  # fmt: skip
Number = Annotated[float, Field(allow_inf_nan=False)]


class _Record(BaseModel):
    """Values of the declared types; keys of other writers are allowed."""

    model_config = ConfigDict(strict=True, extra="allow")


class FeatureRecord(_Record):
    """A feature in ``info.json``."""

    dtype: Dtype
    shape: Annotated[list[Annotated[int, Field(ge=1, le=2**14)]], Field(min_length=1, max_length=4)]
    names: list[str] | dict[str, Any] | None = None
    info: dict[str, Any] | None = None


class InfoRecord(_Record):
    """``meta/info.json``. Paths have LeRobot's own patterns: a pattern of a file could lead anywhere."""

    codebase_version: Literal[schema.CODEBASE_VERSION]  # pyright: ignore[reportInvalidTypeForm]
    robot_type: str | None = None
    total_episodes: Annotated[int, Field(ge=0, le=MAX_EPISODES)]
    total_frames: Annotated[int, Field(ge=0, le=MAX_FRAMES)]
    total_tasks: Annotated[int, Field(ge=0, le=MAX_EPISODES)]
    chunks_size: Annotated[int, Field(ge=1, le=MAX_EPISODES)] = schema.CHUNK_FILES
    data_files_size_in_mb: Annotated[float, Field(gt=0, le=1e6)] = 100
    video_files_size_in_mb: Annotated[float, Field(gt=0, le=1e6)] = 200
    fps: Annotated[int, Field(ge=1, le=1000)]
    splits: dict[str, str]
    features: dict[Name, FeatureRecord]
    data_path: Literal[schema.DATA_PATH]  # pyright: ignore[reportInvalidTypeForm]
    video_path: Literal[schema.VIDEO_PATH] | None = None  # pyright: ignore[reportInvalidTypeForm]

    @model_validator(mode="after")
    def _is_whole(self) -> InfoRecord:
        missing = [key for key in schema.INDICES if key not in self.features]
        if missing:
            raise ValueError(f"features: expected {', '.join(schema.INDICES)}, found no {', '.join(missing)}")
        if self.video_path is None and any(feature.dtype == "video" for feature in self.features.values()):
            raise ValueError("video_path: expected a pattern, as there are videos")
        return self


class ConversionRecord(_Record):
    """``meta/robocas/conversion.json``, and the plan of a conversion that was interrupted."""

    made_with: dict[str, str] = {}
    settings: dict[str, Any] = {}
    train_eps: list[NonNegativeInt] = []
    val_eps: list[NonNegativeInt] = []
    episodes: list[EntryRecord] = []
    left_out: list[EntryRecord] = []


class CameraRecord(_Record):
    """A camera of an episode in ``meta/robocas/episodes.parquet``."""

    intrinsic: Annotated[list[Number], Field(min_length=4, max_length=4)]
    camera_in_parent: Annotated[
        list[Annotated[list[Number], Field(min_length=4, max_length=4)]], Field(min_length=4, max_length=4)
    ]


class CamerasRecord(_Record):
    """The cameras of an episode, by name."""

    cameras: dict[Name, CameraRecord]


SCENES: Mapping[str, Column] = {"episode_index": Column(INTEGER), "scene": Column(TEXT), "cameras": Column(TEXT)}
SUBGOALS: Mapping[str, Column] = {
    "episode_index": Column(INTEGER),
    schema.SUBGOAL_TYPE.key: Column(TEXT),
    schema.SUBTASK_INDEX.key: Column(INTEGER),
}


def episode_columns(names: Iterable[str], features: Mapping[str, Any]) -> dict[str, Column]:
    """Return the columns that ``meta/episodes`` has to have.

    Args:
        names: of the columns that are there; those of depth are optional.
        features: of ``info.json``.
    """
    columns = {
        "episode_index": Column(INTEGER, greatest=MAX_EPISODES - 1),
        "tasks": Column(TEXTS),
        "length": Column(INTEGER, least=1, greatest=MAX_FRAMES),
        "dataset_from_index": Column(INTEGER, greatest=MAX_FRAMES),
        "dataset_to_index": Column(INTEGER, greatest=MAX_FRAMES),
        "data/chunk_index": Column(INTEGER, greatest=_MAX_FILES),
        "data/file_index": Column(INTEGER, greatest=_MAX_FILES),
    }
    videos = [key for key, feature in features.items() if feature["dtype"] == "video"]
    there = {name.rpartition("/")[0] for name in names}
    depth = [f"depth/{schema.camera_of(key)}" for key in videos]
    for prefix in (*(f"videos/{key}" for key in videos), *(name for name in depth if name in there)):
        for name in ("chunk_index", "file_index"):
            columns[f"{prefix}/{name}"] = Column(INTEGER, greatest=_MAX_FILES)
        for name in ("from_timestamp", "to_timestamp"):
            columns[f"{prefix}/{name}"] = Column(NUMBER, greatest=_MAX_SECONDS)
    return columns


def frame_columns(features: Mapping[str, Any]) -> dict[str, Column]:
    """Return the columns that the data have to have; numbers themselves are checked per episode."""
    stored = {key: feature["dtype"] for key, feature in features.items() if feature["dtype"] not in ("image", "video")}
    columns = {key: Column(_kind_of(dtype)) for key, dtype in stored.items()}
    return {**columns, **{key: Column(INTEGER, greatest=MAX_FRAMES) for key in schema.INDICES if key != "timestamp"}}


def _kind_of(dtype: str) -> Kind:
    if dtype == "string":
        return TEXT
    return NUMBERS if dtype.startswith("float") else INTEGERS  # booleans too


def of_our_shapes(features: Mapping[str, Any]) -> bool:
    """Return whether the features are those of datasets written here, in their shapes."""
    return all(features.get(own.key, {}).get("shape") == [own.width] for own in schema.FEATURES)


def wrong_shapes(features: Mapping[str, Any]) -> Iterator[tuple[str, list[int], list[int]]]:
    """Yield key, expected and found shape of features that all have our names but not our shapes."""
    if set(schema.OUR_KEYS) <= set(features):
        for own in schema.FEATURES:
            if features[own.key]["shape"] != [own.width]:
                yield f"features.{own.key}.shape", [own.width], features[own.key]["shape"]


def unknown_numbers(sides: Mapping[str, Sequence[int]], known: Iterable[int]) -> dict[str, list[int]]:
    """Return, by side of a split, the episode numbers that are not known."""
    there = set(known)
    found = {side: [number for number in numbers if number not in there] for side, numbers in sides.items()}
    return {side: numbers for side, numbers in found.items() if numbers}
