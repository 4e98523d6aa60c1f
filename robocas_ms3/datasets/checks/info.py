"""Checks ``data_info.json`` against the episodes on disk."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.actions import action_space
from robocas_ms3.datasets.checks.content import NO_FILE, EpisodeContent, JsonObject, read_object
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.sources.tolerant import SPECS, is_declared
from robocas_ms3.scenes.language.templates import GOAL_TYPES

FILE = schema.DATA_INFO_FILE
RANGE_TOLERANCE = 1e-4


def read_info(root: Path) -> JsonObject:
    """Read the overview."""
    unfinished = (root / schema.CONVERSION_FILE).is_file()
    return read_object(root, FILE, missing=NO_FILE + (": not finished, convert again" if unfinished else ""))


def check_info(overview: JsonObject, episodes: Mapping[int, EpisodeContent]) -> Iterator[Violation]:
    """Check the overview.

    Args:
        overview: ``data_info.json``.
        episodes: number -> content of the episodes on disk.
    """
    if overview.wrong:
        yield overview.wrong
        return
    info, arrays = overview.content, {number: content.stored.arrays for number, content in episodes.items()}
    for key in schema.DATA_INFO:
        if key not in info:
            yield Violation(FILE, key, "this key", "no such key")
    yield from _split(info, set(episodes))
    for key in ("ep_length", "language_goal", "step_goals"):
        if key not in info:
            continue
        if not isinstance(info[key], dict):
            yield Violation(FILE, key, "an object", type(info[key]).__name__)
            continue
        wanted, found = {str(number) for number in episodes}, set(info[key])
        if wanted != found:
            yield Violation(FILE, key, "the episodes on disk", f"{len(wanted ^ found)} others or missing")
        for number in sorted(wanted & found, key=int):
            yield from _entry(key, number, info[key][number], arrays[int(number)])
    if "action_space" in info:
        yield from _ranges(info["action_space"], arrays)


def _split(info: Mapping[str, Any], there: set[int]) -> Iterator[Violation]:
    parts = {key: info[key] for key in ("train_eps", "val_eps") if key in info}
    for key, numbers in parts.items():
        if not isinstance(numbers, list) or not all(type(number) is int for number in numbers):
            yield Violation(FILE, key, "a list of episode numbers", str(numbers)[:60])
            return
        if len(set(numbers)) != len(numbers):
            yield Violation(FILE, key, "each episode once", "repeated numbers")
    if len(parts) < 2:
        return
    train, val = set(parts["train_eps"]), set(parts["val_eps"])
    if train & val:
        yield Violation(FILE, "train_eps, val_eps", "no episode in both", f"{sorted(train & val)} in both")
    if train | val != there:
        different = sorted((train | val) ^ there)
        yield Violation(FILE, "train_eps, val_eps", "the episodes on disk", f"{different} missing or not on disk")


def _entry(key: str, number: str, value: Any, arrays: Mapping[str, NDArray]) -> Iterator[Violation]:
    shown = f"{key}.{number}"
    sound = {name for name, array in arrays.items() if name in SPECS and is_declared(name, array)}
    if key == "ep_length" and "episode_length" in sound:
        if value != int(arrays["episode_length"]):
            yield Violation(FILE, shown, str(int(arrays["episode_length"])), str(value))
    elif key == "language_goal" and "language_goal" in sound:
        if value != str(arrays["language_goal"]):
            yield Violation(FILE, shown, repr(str(arrays["language_goal"])), repr(value))
    elif key == "step_goals" and {"step_lang_goals", "step_goal_type"} <= sound:
        try:
            goals = [
                (g["goal_type"], g["goal_description"], int(g["goal_range"][0]), int(g["goal_range"][1])) for g in value
            ]
        except (KeyError, TypeError, IndexError, ValueError, OverflowError):
            yield Violation(FILE, shown, "goal_type, goal_range [first, last], goal_description", str(value)[:80])
            return
        yield from _goals(shown, goals, arrays)


def _goals(shown: str, goals: list[tuple[str, str, int, int]], arrays: Mapping[str, NDArray]) -> Iterator[Violation]:
    texts, kinds = arrays["step_lang_goals"].tolist(), arrays["step_goal_type"].tolist()
    if len(texts) != len(kinds):
        return  # said already
    next_step = 0
    for kind, text, first, last in goals:
        if kind not in GOAL_TYPES:
            yield Violation(FILE, shown, f"one of {', '.join(GOAL_TYPES)}", kind)
        if first != next_step or last < first:
            yield Violation(FILE, shown, f"a range from {next_step}", f"[{first}, {last}]")
            return
        next_step = last + 1
        if any(goal != (kind, text) for goal in zip(kinds[first : last + 1], texts[first : last + 1], strict=True)):
            steps = f"steps {first} to {last}"
            yield Violation(FILE, shown, f"the sub-goal that {schema.EPISODE_FILE} has at {steps}", repr(text))
    if next_step != len(texts):
        yield Violation(FILE, shown, f"ranges up to step {len(texts) - 1}", f"up to {next_step - 1}")


def _ranges(found: Any, episodes: Mapping[int, Mapping[str, NDArray]]) -> Iterator[Violation]:
    complete = [a for a in episodes.values() if all(np.ndim(a.get(key, 0)) == 2 for key in ("rel_pos", "rel_orn"))]
    try:
        expected = action_space([a["rel_pos"] for a in complete], [a["rel_orn"] for a in complete])
    except ValueError:
        return  # broken arrays, said already
    for key, rows in expected.items():
        try:
            values = np.asarray(found[key], dtype=np.float64)
        except (KeyError, TypeError, ValueError):
            values = np.zeros(0)
        if values.shape != (2, 3):
            yield Violation(FILE, f"action_space.{key}", "[1st percentile (3), 99th percentile (3)]", str(found)[:80])
        elif not (worst := np.abs(values - rows).max()) <= RANGE_TOLERANCE:  # NaN too
            yield Violation(FILE, f"action_space.{key}", "percentiles of the episodes", f"off by {worst:.3g}")
