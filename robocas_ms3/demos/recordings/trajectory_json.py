"""The JSON file of a ManiSkill trajectory: its declared form, and what it says of each episode.

A file is somebody's data: it may choose a seed and ``reconfigure``, and nothing else of ``env.reset``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, NonNegativeInt

from robocas_ms3.core.checks import MAX_SEED
from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.strict_model import parse
from robocas_ms3.core.text import one_line
from robocas_ms3.demos.recordings.subgoals import SubGoal, SubGoals

_ENTRY = "the JSON's entry"


@cache  # it reads the packages' descriptions
def versions() -> dict[str, str]:
    return {name: version(name) for name in ("robocas-ms3", "mani_skill", "sapien", "python-fcl", "torch", "numpy")}


def one_seed(value: Any) -> int | None:
    """Return a seed as an integer, also from a list of one as ManiSkill writes it; None where it is neither."""
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    return value if type(value) is int else None


class _Record(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow", frozen=True)  # further keys are their writer's


def _single_seed(value: Any) -> Any:
    return value if one_seed(value) is None else one_seed(value)


Seed = Annotated[int, BeforeValidator(_single_seed), Field(ge=0, le=MAX_SEED)]
"""A seed of ``env.reset``; ManiSkill writes a list of one."""


class ResetRecord(_Record):
    """``reset_kwargs`` of an episode."""

    options: dict[Literal["reconfigure"], bool] | None = None


class EpisodeHeader(_Record):
    """How an episode begins, in every ManiSkill trajectory."""

    episode_id: int
    episode_seed: Seed
    reset_kwargs: ResetRecord | None = None
    control_mode: str


class TaskRecord(SubGoals):
    """``robocas`` of an episode: what ManiSkill's format has no place for."""

    instruction: str


class EpisodeRecord(EpisodeHeader):
    """An episode that ``robocas generate`` recorded."""

    elapsed_steps: NonNegativeInt | None = None
    robocas: TaskRecord


class _ListedRecord(_Record):
    episode_id: int


class _EnvRecord(_Record):
    env_id: str
    env_kwargs: dict[str, Any]


class RunRecord(_Record):
    """``robocas`` of the file."""

    control_freq: Annotated[FiniteFloat, Field(gt=0)] = 20.0
    versions: dict[str, Any] = {}


class TrajectoryRecord(_Record):
    """The file. Its episodes are read one by one, as one that is damaged does not spoil the others."""

    env_info: _EnvRecord
    episodes: list[_ListedRecord]
    robocas: RunRecord | None = None


@dataclass(frozen=True)
class EpisodeEntry:
    """A recorded episode of S control steps in the JSON.

    Attributes:
        episode_id: number in the trajectory file.
        reset_options: further options of ``env.reset``.
        control_steps: S.
        subgoals: ranges over the actions 0..S-1.
        is_intervention: whether it begins where another policy was, instead of at the reset.
    """

    episode_id: int
    seed: int
    reset_options: dict[str, Any]
    control_mode: str
    control_steps: int
    instruction: str
    subgoals: list[SubGoal]
    is_intervention: bool


def read_entry(episode: Mapping[str, Any], where: object) -> EpisodeEntry:
    found = parse(EpisodeRecord, episode, DatasetError, where=where, about=_ENTRY)
    goals = found.robocas.subgoals
    steps = found.elapsed_steps
    if steps is None and not goals:
        raise DatasetError("the JSON's entry does not say how long the episode is", where=where)
    return EpisodeEntry(
        episode_id=found.episode_id,
        seed=found.episode_seed,
        reset_options=_options(found.reset_kwargs),
        control_mode=found.control_mode,
        control_steps=goals[-1].last + 1 if steps is None else steps,
        instruction=found.robocas.instruction,
        subgoals=goals,
        is_intervention=is_intervention(episode),
    )


def is_intervention(episode: Mapping[str, Any]) -> bool:
    """Whether an episode begins where another policy was."""
    recorded = episode.get("robocas")
    return isinstance(recorded, Mapping) and recorded.get("intervention") is not None


def read_reset(episode: Mapping[str, Any], where: object) -> tuple[int, dict[str, Any], str]:
    """Return seed and options of ``env.reset`` that an episode begins with, and the control mode of its actions."""
    found = parse(EpisodeHeader, episode, DatasetError, where=where, about=_ENTRY)
    return found.episode_seed, _options(found.reset_kwargs), found.control_mode


def read_reset_options(options: Any, where: object) -> dict[str, Any]:
    return _options(parse(ResetRecord, {"options": options or None}, DatasetError, where=where))


def _options(reset: ResetRecord | None) -> dict[str, Any]:
    return {**reset.options} if reset and reset.options else {}


def read_json(trajectory: Path) -> dict[str, Any]:
    """Read the JSON of a trajectory in the form of `TrajectoryRecord`."""
    path, about = trajectory.with_suffix(".json"), "not a trajectory's JSON"
    if not path.is_file():
        raise DatasetError("the JSON that belongs to this trajectory is missing", where=path)
    try:
        metadata = load_json(path)
    except (ValueError, RecursionError) as error:
        raise DatasetError(about, where=path, expected="env_info and episodes", found=one_line(error)) from error
    parse(TrajectoryRecord, metadata, DatasetError, where=path, about=about)
    return metadata
