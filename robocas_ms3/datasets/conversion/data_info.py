"""Overview files of a RoboCAS folder: ``data_info.json``, which has the split, and ``failures.jsonl``."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.files import write_json
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.core.text import one_line
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.actions import compute_action_space
from robocas_ms3.datasets.sources.arrays import read_arrays
from robocas_ms3.datasets.sources.file_models import DataInfoRecord
from robocas_ms3.datasets.sources.files import SEE_VALIDATE
from robocas_ms3.datasets.sources.provenance import compute_environment_id, parse_task_name
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.datasets.sources.split import split_by_seed
from robocas_ms3.demos.failures import FAILURES_FILE
from robocas_ms3.demos.recordings.subgoals import group_subgoals

_NEEDED = ("episode_length", "language_goal", "step_goal_type", "step_lang_goals", "rel_pos", "rel_orn")


def write_data_info(root: Path, previous: tuple[Iterable[int], Iterable[int]] = ((), ())) -> None:
    """Write ``data_info.json`` for the episodes on disk.

    ``previous``: training and validation episodes of the current split; they keep their split, see `split_by_seed`.
    """
    write_json(root / schema.DATA_INFO_FILE, build_data_info(root, previous))


def build_data_info(root: Path, previous: tuple[Iterable[int], Iterable[int]] = ((), ())) -> dict[str, Any]:
    """Compute the content of ``data_info.json`` from the episodes on disk.

    ``previous``: training and validation episodes of the current split; they keep their split, see `split_by_seed`.
    """
    dataset = Dataset(root)
    seeds, lengths, instructions, goals = {}, {}, {}, {}
    positions, orientations = [], []
    for number in dataset.numbers:
        episode = dataset.episode(number)
        path = episode.folder / schema.EPISODE_FILE
        arrays = read_arrays(path, _NEEDED).require(_NEEDED)
        for key in ("rel_pos", "rel_orn"):
            if not np.isfinite(arrays[key]).all():
                what, expected = "NaN or infinite value in the motion of this episode", "finite numbers"
                raise DatasetError(what, where=f"{path}, {key}", expected=expected, fix=SEE_VALIDATE)
        seeds[number] = episode.scene.get("seed")
        lengths[str(number)] = int(arrays["episode_length"])
        instructions[str(number)] = str(arrays["language_goal"])
        runs = group_subgoals(arrays["step_goal_type"].tolist(), arrays["step_lang_goals"].tolist())
        goals[str(number)] = [goal.model_dump() for goal in runs]
        positions.append(arrays["rel_pos"])
        orientations.append(arrays["rel_orn"])
    train, val = split_by_seed(seeds, previous)
    info: dict[str, Any] = {
        "train_eps": train,
        "val_eps": val,
        "ep_length": lengths,
        "language_goal": instructions,
        "step_goals": goals,
    }
    try:
        info["action_space"] = compute_action_space(positions, orientations)
        DataInfoRecord.model_validate(info)
    except (ValueError, IndexError) as error:  # a quaternion of length 0, or no episode with two steps
        where = f"{root / schema.DATA_INFO_FILE}, action_space"
        found = one_line(error)
        raise DatasetError(
            "action_space can't be computed from these episodes", where=where, found=found, fix=SEE_VALIDATE
        ) from error
    return info


def copy_failures(run: Path, out: Path, env_info: Mapping[str, Any]) -> None:
    """Append the ``failures.jsonl`` of a run to the file of a dataset, without duplicates.

    Each new line also gets the task and the environment of the run.
    """
    made_in = {"task": parse_task_name(str(env_info.get("env_id"))), "environment": compute_environment_id(env_info)}
    there: JsonLinesFile[dict[str, Any]] = JsonLinesFile(out / FAILURES_FILE, dict[str, Any])
    failures: JsonLinesFile[dict[str, Any]] = JsonLinesFile(run / FAILURES_FILE, dict[str, Any])
    known = {_line_key(line) for line in there.read()}
    marked = ((line, {**line, **made_in}) for line in failures.read())
    new = [line for before, line in marked if not {_line_key(before), _line_key(line)} & known]
    if new:  # rewritten, because the file may be hard-linked from another dataset
        there.rewrite([*there.read(), *new])


def _line_key(line: Mapping[str, Any]) -> str:
    return json.dumps(line, sort_keys=True)
