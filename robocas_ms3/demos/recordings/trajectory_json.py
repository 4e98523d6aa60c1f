"""Models and readers of the JSON file of a ManiSkill trajectory.

Files are untrusted data: a file may set the seed and ``reconfigure`` of ``env.reset``, and no other option.
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

_ENTRY = "invalid episode entry"


@cache  # reads package metadata from disk
def package_versions() -> dict[str, str]:
    """Return the versions of this package and of its main dependencies."""
    return {name: version(name) for name in ("robocas-ms3", "mani_skill", "sapien", "python-fcl", "torch", "numpy")}


def parse_seed(value: Any) -> int | None:
    """Return a seed as an integer, also from a list of one seed as ManiSkill writes it; None if invalid."""
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    return value if type(value) is int else None


class _Record(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow", frozen=True)  # other tools may add keys


def _single_seed(value: Any) -> Any:
    return value if parse_seed(value) is None else parse_seed(value)


Seed = Annotated[int, BeforeValidator(_single_seed), Field(ge=0, le=MAX_SEED)]
"""A seed of ``env.reset``; ManiSkill writes a list with one seed."""


class ResetRecord(_Record):
    """``reset_kwargs`` of an episode."""

    options: dict[Literal["reconfigure"], bool] | None = None


class EpisodeHeader(_Record):
    """Keys of an episode entry in any ManiSkill trajectory that define its reset."""

    episode_id: int
    episode_seed: Seed
    reset_kwargs: ResetRecord | None = None
    control_mode: str


class TaskRecord(SubGoals):
    """Key ``robocas`` of an episode entry: data beyond ManiSkill's format."""

    instruction: str


class EpisodeRecord(EpisodeHeader):
    """Episode entry written by ``robocas generate``."""

    elapsed_steps: NonNegativeInt | None = None
    robocas: TaskRecord


class _ListedRecord(_Record):
    episode_id: int


class _EnvRecord(_Record):
    env_id: str
    env_kwargs: dict[str, Any]


class RunRecord(_Record):
    """Key ``robocas`` of the file."""

    control_freq: Annotated[FiniteFloat, Field(gt=0)] = 20.0
    versions: dict[str, Any] = {}


class TrajectoryRecord(_Record):
    """The file. Episode entries are validated one by one, so that a damaged one affects no other."""

    env_info: _EnvRecord
    episodes: list[_ListedRecord]
    robocas: RunRecord | None = None


@dataclass(frozen=True)
class EpisodeEntry:
    """JSON entry of a recorded episode of S control steps.

    Attributes:
        episode_id: number in the trajectory file.
        reset_options: options of ``env.reset``.
        control_steps: S.
        subgoals: sub-goals with ranges over the actions 0..S-1.
        is_intervention: whether the episode starts in a state that another policy reached, not at the reset.
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
    """Read the entry of an episode in the JSON; raise DatasetError if it is invalid."""
    found = parse(EpisodeRecord, episode, DatasetError, where=where, about=_ENTRY)
    goals = found.robocas.subgoals
    steps = found.elapsed_steps
    if steps is None and not goals:
        raise DatasetError("unknown length of the episode", where=where, expected="elapsed_steps or subgoals")
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
    """Return whether an episode starts in a state that another policy reached."""
    recorded = episode.get("robocas")
    return isinstance(recorded, Mapping) and recorded.get("intervention") is not None


def read_reset(episode: Mapping[str, Any], where: object) -> tuple[int, dict[str, Any], str]:
    """Read seed and options of ``env.reset`` and the control mode of an episode entry."""
    found = parse(EpisodeHeader, episode, DatasetError, where=where, about=_ENTRY)
    return found.episode_seed, _options(found.reset_kwargs), found.control_mode


def read_reset_options(options: Any, where: object) -> dict[str, Any]:
    return _options(parse(ResetRecord, {"options": options or None}, DatasetError, where=where))


def _options(reset: ResetRecord | None) -> dict[str, Any]:
    return {**reset.options} if reset and reset.options else {}


def read_json(trajectory: Path) -> dict[str, Any]:
    """Read the JSON file of a trajectory, validated as `TrajectoryRecord`."""
    path, about = trajectory.with_suffix(".json"), "not the JSON file of a trajectory"
    if not path.is_file():
        raise DatasetError("missing JSON file of the trajectory", where=path)
    try:
        metadata = load_json(path)
    except (ValueError, RecursionError) as error:
        raise DatasetError(about, where=path, expected="env_info and episodes", found=one_line(error)) from error
    parse(TrajectoryRecord, metadata, DatasetError, where=path, about=about)
    return metadata
