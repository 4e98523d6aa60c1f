"""Overviews of a RoboCAS folder: ``data_info.json``, which has the split, and ``failures.jsonl``."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import write_json
from robocas_ms3.core.ledger import Ledger
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.actions import action_space
from robocas_ms3.datasets.sources.provenance import environment_of, task_of
from robocas_ms3.datasets.sources.reader import Dataset, Episode
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.datasets.sources.tolerant import first_line, read_arrays
from robocas_ms3.demos.ledger import FAILURES_FILE
from robocas_ms3.demos.recordings.entries import one_seed
from robocas_ms3.demos.recordings.subgoals import SubGoal, subgoal_runs


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
    arrays = read_arrays(episode.folder / schema.EPISODE_FILE, _NEEDED).needed(_NEEDED)
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
        subgoal_runs(arrays["step_goal_type"].tolist(), arrays["step_lang_goals"].tolist()),
        arrays["rel_pos"],
        arrays["rel_orn"],
    )


_NEEDED = ("episode_length", "language_goal", "step_goal_type", "step_lang_goals", "rel_pos", "rel_orn")


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


def add_failures(run: Path, out: Path, env_info: Mapping[str, Any]) -> None:
    """Add a run's lines that the dataset does not have yet.

    Each gets ``task`` and ``environment``, as a seed alone does not tell which of several runs it is of.

    Args:
        run: folder with the trajectory; where there is no such file in it, nothing is done. Lines cut off by a crash
            stay there.
        out: the dataset.
        env_info: of the trajectory.
    """
    made_in = {"task": task_of(str(env_info.get("env_id"))), "environment": environment_of(env_info)}
    there = _lines_of(out)
    known = {_key(line) for line in there.read()}
    marked = ((line, {**line, **made_in}) for line in _lines_of(run).read())
    new = [line for before, line in marked if not {_key(before), _key(line)} & known]
    if new:  # anew: files of a dataset may be linked from another one
        there.rewrite([*there.read(), *new])


def _lines_of(folder: Path) -> Ledger[dict[str, Any]]:
    return Ledger(folder / FAILURES_FILE, dict[str, Any])


def _key(line: Mapping[str, Any]) -> str:
    return json.dumps(line, sort_keys=True)
