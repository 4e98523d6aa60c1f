"""The JSON beside a ManiSkill trajectory: what it says of each episode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import DatasetError
from robocas_ms3.demos.recordings.seeds import GREATEST_SEED, one_seed
from robocas_ms3.demos.recordings.subgoals import SubGoal, read_subgoals

_RESET_OPTIONS = ("reconfigure",)  # that a file may have


@dataclass(frozen=True)
class Entry:
    """What the JSON says of a recorded episode of S control steps.

    Attributes:
        episode_id: number in the trajectory file.
        seed: the environment's seed, which builds its scene.
        reset_options: further options of ``env.reset``.
        control_mode: of the actions.
        control_steps: S.
        instruction: what the robot was told.
        subgoals: ranges over the actions 0..S-1.
        taken_over: whether it begins where another policy was, to which the seed alone does not lead.
    """

    episode_id: int
    seed: int
    reset_options: dict[str, Any]
    control_mode: str
    control_steps: int
    instruction: str
    subgoals: list[SubGoal]
    taken_over: bool


def read_entry(episode: Mapping[str, Any], where: object) -> Entry:
    """What a trajectory's JSON says of an episode.

    Raises:
        DatasetError: it says something else, or more than a file may choose.
    """
    try:
        said = episode["robocas"]
        goals = read_subgoals(said["subgoals"], f"{where}, subgoals")
        seed, options = read_reset(episode, where)
        entry = Entry(
            episode_id=episode["episode_id"],
            seed=seed,
            reset_options=options,
            control_mode=episode["control_mode"],
            control_steps=episode["elapsed_steps"] if "elapsed_steps" in episode else goals[-1].last + 1,
            instruction=said["instruction"],
            subgoals=goals,
            taken_over=was_taken_over(episode),
        )
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise DatasetError("the JSON's entry is incomplete", where=where, found=reason(error)) from error
    for key, sound, expected in (
        ("episode_id", type(entry.episode_id) is int, "an integer"),
        ("elapsed_steps", type(entry.control_steps) is int, "an integer"),
        ("control_mode", isinstance(entry.control_mode, str), "text"),
        ("robocas.instruction", isinstance(entry.instruction, str), "text"),
    ):
        if not sound:
            raise DatasetError("the JSON's entry is wrong", where=f"{where}, {key}", expected=expected)
    return entry


def was_taken_over(episode: Mapping[str, Any]) -> bool:
    """Whether an episode begins where another policy was, by the JSON's entry or ``scene.json``'s ``recorded``."""
    said = episode.get("robocas", episode.get("recorded"))
    return isinstance(said, Mapping) and said.get("takeover") is not None


def read_reset(episode: Mapping[str, Any], where: object) -> tuple[int, dict[str, Any]]:
    """Seed and options of ``env.reset`` that an episode begins with.

    Raises:
        DatasetError: there is no such seed, or the options do more than a file may.
    """
    seed = one_seed(episode.get("episode_seed"))
    if seed is None or not 0 <= seed <= GREATEST_SEED:
        place, found = f"{where}, episode_seed", str(episode.get("episode_seed"))[:40]
        raise DatasetError("no such seed", where=place, expected=f"an integer from 0 to {GREATEST_SEED}", found=found)
    begins = episode.get("reset_kwargs") or {}
    options = begins.get("options") if isinstance(begins, dict) else begins
    return seed, read_reset_options(options, f"{where}, reset_kwargs.options")


def read_reset_options(options: Any, where: object) -> dict[str, Any]:
    """Options of ``env.reset`` in a file.

    Raises:
        DatasetError: they do more than a file may.
    """
    if not options:
        return {}
    if not isinstance(options, dict) or any(k not in _RESET_OPTIONS or type(v) is not bool for k, v in options.items()):
        expected = f"at most {', '.join(_RESET_OPTIONS)}: true or false"
        raise DatasetError("a file can't choose these", where=where, expected=expected, found=str(options)[:80])
    return options


def read_json(trajectory: Path) -> dict[str, Any]:
    """Read the JSON beside a trajectory: at least ``env_info`` and ``episodes``, each with its number.

    Raises:
        DatasetError: it is missing or damaged.
    """
    path = trajectory.with_suffix(".json")
    if not path.is_file():
        raise DatasetError("the JSON that belongs to this trajectory is missing", where=path)
    try:
        metadata = load_json(path)
        episodes = metadata["episodes"]
        missing = {"env_id", "env_kwargs"} - set(metadata["env_info"])
        if missing:
            raise KeyError(*sorted(missing))
        if not isinstance(episodes, list) or not all(type(one["episode_id"]) is int for one in episodes):
            raise TypeError("episodes without numbers")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(
            "not a trajectory's JSON", where=path, expected="env_info and episodes", found=reason(error)
        ) from error
    return metadata


def reason(error: Exception) -> str:
    """What an error says, in a line."""
    text = str(error).strip() or type(error).__name__
    return f"no key {text}" if isinstance(error, KeyError) else text.splitlines()[0]
