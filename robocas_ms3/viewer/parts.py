"""What the page is told: a row of the table, an episode, its plots and its trace."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

CAMERA_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,79}")
"""Cameras of other names, which a dataset made elsewhere may have, are left out: names become addresses and folders."""


@dataclass(frozen=True)
class Picture:
    """An encoded picture.

    Attributes:
        kind: media type, ``image/png``, ``image/jpeg`` or ``image/webp``.
        data: the file.
    """

    kind: str
    data: bytes


def make_index(
    path: Path, kind: str, rate_hz: float, cameras: Sequence[str], depth: bool, episodes: list[dict], note: str = ""
) -> dict[str, Any]:
    """What the table shows.

    Args:
        path: of the dataset.
        kind: its format, for people.
        rate_hz: steps a second.
        cameras: names; empty where there are no pictures.
        depth: whether there is depth.
        episodes: from `row`.
        note: what people should know of it.
    """
    return {
        "name": path.resolve().name if path.is_dir() else f"{path.resolve().parent.name}/{path.name}",
        "kind": kind,
        "rate_hz": rate_hz,
        "cameras": [name for name in cameras if CAMERA_NAME.fullmatch(name)],
        "depth": depth,
        "note": note,
        "episodes": episodes,
    }


def row(
    number: int | None,
    *,
    steps: int = 0,
    instruction: str = "",
    task: str = "",
    target: str = "",
    seed: int | None = None,
    success: bool | None = None,
    split: str = "",
    stages: Sequence[str] = (),
    attempts: int | None = None,
    damage: str = "",  # what of the episode is wrong, and therefore not shown
) -> dict[str, Any]:
    """A line of the table; ``number`` None is a seed that was given up, ``stages`` where attempts at it failed."""
    return {
        "n": number,
        "steps": steps,
        "instruction": instruction,
        "task": task,
        "object": target,
        "seed": seed,
        "success": success,
        "split": split,
        "stages": sorted(set(stages)),
        "attempts": attempts,
        "damage": damage,
    }


def plot(title: str, unit: str, names: Sequence[str], values: NDArray, *, steps: bool = False) -> dict[str, Any]:
    """A plot of (T, N) values; ``steps`` draws them as levels that hold until the next value."""
    columns = np.atleast_2d(np.asarray(values, float).T)
    series = [{"name": name, "values": rounded(column)} for name, column in zip(names, columns, strict=True)]
    return {"title": title, "unit": unit, "series": series, "steps": steps}


def rounded(values: Any) -> list:
    """Nested lists of numbers, short enough to send; NaN and infinity, which JSON lacks, become None."""
    array = np.round(np.asarray(values, float), 5) + 0.0  # + 0.0: no -0.0
    if np.isfinite(array).all():
        return array.tolist()
    known = array.astype(object)
    known[~np.isfinite(array)] = None
    return known.tolist()
