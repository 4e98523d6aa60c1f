"""Checks ``data_info.json`` against the episodes on disk."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.actions import action_space
from robocas_ms3.datasets.checks.violation import NO_FILE, Violation, read_object
from robocas_ms3.datasets.sources.records import DataInfoRecord
from robocas_ms3.datasets.sources.tolerant import SPECS, is_declared

FILE = schema.DATA_INFO_FILE
_RANGE_TOLERANCE = 1e-4
_Arrays = Mapping[str, NDArray]


def check_info(root: Path, episodes: Mapping[int, _Arrays]) -> Iterator[Violation]:
    """Check the overview.

    Args:
        root: folder of the dataset.
        episodes: number -> arrays of the episodes on disk.
    """
    unfinished = ": not finished, convert again" if (root / schema.CONVERSION_FILE).is_file() else ""
    info, wrong = read_object(root, FILE, DataInfoRecord, missing=NO_FILE + unfinished)
    if wrong:
        yield from wrong
        return
    yield from _check_split(info["train_eps"], info["val_eps"], set(episodes))
    for key in ("ep_length", "language_goal", "step_goals"):
        wanted, found = {str(number) for number in episodes}, set(info[key])
        if wanted != found:
            yield Violation(FILE, key, "the episodes on disk", f"{len(wanted ^ found)} others or missing")
    for number, arrays in sorted(episodes.items()):
        declared = {key: array for key, array in arrays.items() if key in SPECS and is_declared(key, array)}
        entries = {key: info[key].get(str(number)) for key in ("ep_length", "language_goal", "step_goals")}
        yield from _check_entries(entries, number, declared)
    yield from _check_range(info["action_space"], episodes)


def _check_split(train: list[int], val: list[int], there: set[int]) -> Iterator[Violation]:
    for key, numbers in (("train_eps", train), ("val_eps", val)):
        if len(set(numbers)) != len(numbers):
            yield Violation(FILE, key, "each episode once", "repeated numbers")
    both, different = sorted(set(train) & set(val)), sorted(({*train, *val}) ^ there)
    if both:
        yield Violation(FILE, "train_eps, val_eps", "no episode in both", f"{both} in both")
    if different:
        yield Violation(FILE, "train_eps, val_eps", "the episodes on disk", f"{different} missing or not on disk")


def _check_entries(info: Mapping[str, Any], number: int, arrays: _Arrays) -> Iterator[Violation]:
    """Compare the overview of an episode with its arrays; entries and arrays may be missing."""
    for key, array, kind in (("ep_length", "episode_length", int), ("language_goal", "language_goal", str)):
        if info[key] is not None and array in arrays and info[key] != (expected := kind(arrays[array])):
            yield Violation(FILE, f"{key}.{number}", repr(expected), repr(info[key]))
    if info["step_goals"] is None or not {"step_lang_goals", "step_goal_type"} <= arrays.keys():
        return
    shown = f"step_goals.{number}"
    texts, types = arrays["step_lang_goals"].tolist(), arrays["step_goal_type"].tolist()
    next_step = 0
    for goal in info["step_goals"]:
        first, last = goal["goal_range"]
        if first != next_step:
            yield Violation(FILE, shown, f"a range from {next_step}", f"[{first}, {last}]")
            return
        next_step = last + 1
        kept = {*zip(types[first:next_step], texts[first:next_step], strict=False)}
        if kept - {(goal["goal_type"], goal["goal_description"])}:
            steps = f"steps {first} to {last}"
            found = repr(goal["goal_description"])
            yield Violation(FILE, shown, f"the sub-goal that {schema.EPISODE_FILE} has at {steps}", found)
    if next_step != len(texts):
        yield Violation(FILE, shown, f"ranges up to step {len(texts) - 1}", f"up to {next_step - 1}")


def _check_range(info: Mapping[str, Any], episodes: Mapping[int, _Arrays]) -> Iterator[Violation]:
    complete = [a for a in episodes.values() if all(np.ndim(a.get(key, 0)) == 2 for key in ("rel_pos", "rel_orn"))]
    try:
        expected = action_space([a["rel_pos"] for a in complete], [a["rel_orn"] for a in complete])
    except ValueError:
        return  # damaged arrays, see `arrays`
    for key, rows in expected.items():
        worst = np.abs(np.subtract(info[key], rows)).max()
        if worst > _RANGE_TOLERANCE:
            yield Violation(FILE, f"action_space.{key}", "percentiles of the episodes", f"off by {worst:.3g}")
