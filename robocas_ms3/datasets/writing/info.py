"""``data_info.json``: what is in a dataset, and how it splits into training and validation."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.reader import Dataset, Episode
from robocas_ms3.datasets.sources.tolerant import DAMAGED, first_line
from robocas_ms3.errors import DatasetError
from robocas_ms3.files import write_json
from robocas_ms3.recordings.seeds import one_seed
from robocas_ms3.recordings.subgoals import SubGoal

SPLIT_RULE = (
    "seeds in the order of sha256(seed), the first tenth validates; episodes of one seed stay together; what is"
    " appended changes no earlier episode's side"
)


def split_by_seed(
    seeds: Mapping[int, int], before: tuple[Iterable[int], Iterable[int]] = ((), ())
) -> tuple[list[int], list[int]]:
    """Split episodes 90 : 10. A seed's place depends on no order and no generator, only on the other seeds.

    Args:
        seeds: episode number -> seed.
        before: training and validation episodes so far; they and their seeds keep their side, and of the new seeds as
            many validate as make up a tenth of all.

    Returns:
        Training and validation episodes, sorted. At least one seed validates where there are two.
    """
    old = [{seeds[number] for number in numbers if number in seeds} for numbers in before]
    ranked = sorted(set(seeds.values()), key=lambda seed: hashlib.sha256(str(seed).encode()).hexdigest())
    count = max(1, round(len(ranked) / 10)) if len(ranked) > 1 else 0
    new = [seed for seed in ranked if seed not in old[0] | old[1]]
    chosen = old[1] | set(new[: max(0, count - len(old[1]))])
    kept = set(before[0])  # an episode that trains goes on to, whatever others of its seed do
    val = sorted(number for number, seed in seeds.items() if seed in chosen and number not in kept)
    return sorted(set(seeds) - set(val)), val


def action_space(rel_pos: Sequence[NDArray], rel_orn: Sequence[NDArray]) -> dict[str, list[list[float]]]:
    """Range of the relative motions: 1st and 99th percentile of each axis over all episodes.

    Args:
        rel_pos: (T, 3) of each episode; the last row, which is no motion, does not count.
        rel_orn: (T, 4) xyzw of each episode.
    """
    positions = np.concatenate([rows[:-1] for rows in rel_pos]).astype(np.float64)
    quaternions = np.concatenate([rows[:-1] for rows in rel_orn]).astype(np.float64)
    angles = Rotation.from_quat(quaternions).as_euler("xyz")
    return {
        "relative_position": np.percentile(positions, [1, 99], axis=0).tolist(),
        "relative_rotation": np.percentile(angles, [1, 99], axis=0).tolist(),
    }


@dataclass(frozen=True)
class Summary:
    """What the overview says of an episode.

    Attributes:
        seed: that decides its side of the split.
        length: T.
        instruction: what the robot was told.
        subgoals: in order, without gaps.
        rel_pos, rel_orn: (T, 3) m and (T, 4) xyzw.
    """

    seed: int
    length: int
    instruction: str
    subgoals: list[SubGoal]
    rel_pos: NDArray
    rel_orn: NDArray


def summarize(episode: Episode, number: int) -> Summary:
    """Read what the overview needs of an episode; one of unknown seed counts as one of a seed of its own.

    Raises:
        DatasetError: its arrays can't be read, or its motion is no numbers.
    """
    try:
        with np.load(episode.folder / schema.EPISODE_FILE, allow_pickle=False) as content:
            arrays = {key: content[key] for key in _NEEDED}
    except (*DAMAGED, KeyError, TypeError) as error:  # TypeError: a single array, not an archive
        raise DatasetError(
            "this episode can't be read",
            where=episode.folder / schema.EPISODE_FILE,
            found=first_line(error),
            fix="robocas validate says what is wrong.",
        ) from error
    for key in ("rel_pos", "rel_orn"):
        if not np.isfinite(arrays[key]).all():
            where = f"{episode.folder / schema.EPISODE_FILE}, {key}"
            fix = "robocas validate says what is wrong."
            raise DatasetError("this episode's motion is no numbers", where=where, expected="finite numbers", fix=fix)
    seed = one_seed(episode.scene.get("seed"))
    return Summary(
        number if seed is None else seed,
        int(arrays["episode_length"]),
        str(arrays["language_goal"]),
        runs(arrays["step_goal_type"].tolist(), arrays["step_lang_goals"].tolist()),
        arrays["rel_pos"],
        arrays["rel_orn"],
    )


_NEEDED = ("episode_length", "language_goal", "step_goal_type", "step_lang_goals", "rel_pos", "rel_orn")


def runs(types: Sequence[str], texts: Sequence[str]) -> list[SubGoal]:
    """Sub-goals of steps that follow each other."""
    goals: list[SubGoal] = []
    for (kind, text), steps in groupby(range(len(types)), key=lambda step: (types[step], texts[step])):
        inside = list(steps)
        goals.append(SubGoal(kind, text, inside[0], inside[-1]))
    return goals


def write_info(root: Path, before: tuple[Iterable[int], Iterable[int]] = ((), ())) -> dict[str, Any]:
    """Write ``data_info.json`` from the episodes on disk, and give its content; parameters and errors of `info_of`."""
    info = info_of(root, before)
    write_json(root / schema.DATA_INFO_FILE, info)
    return info


def info_of(root: Path, before: tuple[Iterable[int], Iterable[int]] = ((), ())) -> dict[str, Any]:
    """Content of ``data_info.json`` by the episodes on disk.

    Args:
        root: the dataset.
        before: of `split_by_seed`.

    Raises:
        DatasetError: an episode can't be read, or there is no motion to give a range of.
    """
    dataset = Dataset(root)
    episodes = {number: summarize(dataset.episode(number), number) for number in dataset.numbers}
    try:
        info = data_info(episodes, before)
        json.dumps(info, allow_nan=False)  # JSON knows no NaN: many readers refuse a file with one
    except (ValueError, IndexError) as error:  # quaternions of length 0; no episode of two steps
        where, fix = f"{root / schema.DATA_INFO_FILE}, action_space", "robocas validate says what is wrong."
        raise DatasetError("the motion has no range", where=where, found=first_line(error), fix=fix) from error
    return info


def data_info(
    episodes: Mapping[int, Summary], before: tuple[Iterable[int], Iterable[int]] = ((), ())
) -> dict[str, Any]:
    """Content of ``data_info.json``; the mapping is by episode number, ``before`` that of `split_by_seed`."""
    train, val = split_by_seed({number: episode.seed for number, episode in episodes.items()}, before)
    parts = list(episodes.values())
    return {
        "train_eps": train,
        "val_eps": val,
        "ep_length": {str(number): episode.length for number, episode in episodes.items()},
        "language_goal": {str(number): episode.instruction for number, episode in episodes.items()},
        "step_goals": {str(n): [goal.as_json() for goal in episode.subgoals] for n, episode in episodes.items()},
        "action_space": action_space([e.rel_pos for e in parts], [e.rel_orn for e in parts]),
    }
