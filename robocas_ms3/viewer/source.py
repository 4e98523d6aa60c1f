"""What the page shows, whatever it is read from: a small protocol, and the choice of the adapter by what lies there."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.errors import DatasetError
from robocas_ms3.viewer.damage import readable

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


class Source(Protocol):
    """A trajectory file or dataset. All methods may be called from several threads."""

    root: Path

    def index(self) -> dict[str, Any]:
        """Everything the episode table needs, see `make_index`; cheap enough for thousands of episodes."""
        ...

    def episode(self, number: int) -> dict[str, Any]:
        """One episode, see `make_episode`.

        Raises:
            DatasetError: there is none of this number, or it can't be read.
        """
        ...

    def rgb(self, number: int, camera: str, step: int) -> Picture:
        """A picture as it is stored.

        Raises:
            DatasetError: there is none.
        """
        ...

    def depth(self, number: int, camera: str, step: int) -> NDArray[np.uint16]:
        """(H, W) mm, 0 = nothing.

        Raises:
            DatasetError: there is none.
        """
        ...


def open_source(path: Path | str) -> Source:
    """Open a trajectory file, a RoboCAS folder or a LeRobot folder.

    Raises:
        DatasetError: it is none of them, or damaged.
    """
    path = Path(path)
    if path.suffix in (".h5", ".hdf5") or (path.is_dir() and (path / "trajectory.h5").is_file()):
        from robocas_ms3.viewer.trajectory import TrajectorySource

        return TrajectorySource(path / "trajectory.h5" if path.is_dir() else path)
    if (path / "meta" / "info.json").is_file():
        from robocas_ms3.viewer.lerobot import LeRobotSource

        return LeRobotSource(path)
    if path.is_dir():
        from robocas_ms3.viewer.robocas import RoboCASSource

        return RoboCASSource(path)
    raise DatasetError(
        "nothing to view here",
        where=path,
        expected="a trajectory.h5 of robocas generate, a RoboCAS folder or a LeRobot folder",
        found="no such file or folder" if not path.exists() else "another kind of file",
    )


def read_episode(source: Source, number: int) -> dict[str, Any]:
    """One episode of a source, whatever may be wrong with it.

    Raises:
        DatasetError: there is none of this number, or it can't be read.
    """
    where = f"{source.root.name}, episode {number}"
    with readable(where):
        content = source.episode(number)
    if content["steps"] < 1:
        raise DatasetError("this episode has no steps", where=where)
    return content


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


def make_episode(
    number: int,
    *,
    instruction: str,
    steps: int,
    rate_hz: float,
    subgoals: Sequence[dict],
    plots: Sequence[dict],
    trace: dict[str, Any] | None,
    facts: dict[str, Any],
    failures: Sequence[dict] = (),
    times: Sequence[float] | None = None,
) -> dict[str, Any]:
    """All of an episode but its pictures.

    Args:
        number: of the episode.
        instruction: what the robot was told.
        steps: T; all series have this many values.
        rate_hz: steps a second.
        subgoals: {type, text, first, last}.
        plots: from `plot`.
        trace: from `make_trace`; None where it is not known.
        facts: {name: value} for people.
        failures: {stage, reason, text} of attempts that failed.
        times: (T,) s where steps are not all equally long.
    """
    return {
        "n": number,
        "instruction": instruction,
        "steps": steps,
        "times": rounded(np.arange(steps) / rate_hz if times is None else times),
        "subgoals": list(subgoals),
        "plots": [p for p in plots if p["series"]],
        "trace": trace,
        "facts": {name: value for name, value in facts.items() if value not in (None, "", {}, [])},
        "failures": list(failures),
    }


def plot(title: str, unit: str, names: Sequence[str], values: NDArray, *, steps: bool = False) -> dict[str, Any]:
    """A plot of (T, N) values; ``steps`` draws them as levels that hold until the next value."""
    columns = np.atleast_2d(np.asarray(values, float).T)
    series = [{"name": name, "values": rounded(column)} for name, column in zip(names, columns, strict=True)]
    return {"title": title, "unit": unit, "series": series, "steps": steps}


def make_trace(tcp_in_world: NDArray, objects: Sequence[dict], *, moving: bool) -> dict[str, Any]:
    """What the 3-D view shows, in the world's frame.

    Args:
        tcp_in_world: (T, 4, 4) or, where orientation is not known, (T, 3).
        objects: {name, target, path}: path (T, 3), or (1, 3) where only its start is known.
        moving: whether the objects' motion is known.
    """
    poses = np.asarray(tcp_in_world, float)
    full = poses.ndim == 3
    return {
        "tcp": rounded(poses[:, :3, 3] if full else poses),
        "approach": rounded(poses[:, :3, 2]) if full else None,
        "objects": [{**thing, "path": rounded(thing["path"])} for thing in objects],
        "moving": moving,
    }


def inside_path(path: Path, root: Path) -> Path:
    """The path, unless it is a link that leads out of the dataset.

    Raises:
        DatasetError: it is.
    """
    if not path.resolve().is_relative_to(root.resolve()):
        raise DatasetError("this link leads out of the dataset", where=path)
    return path


def rounded(values: Any) -> list:
    """Nested lists of numbers, short enough to send; NaN and infinity, which JSON lacks, become None."""
    array = np.round(np.asarray(values, float), 5) + 0.0  # + 0.0: no -0.0
    if np.isfinite(array).all():
        return array.tolist()
    known = array.astype(object)
    known[~np.isfinite(array)] = None
    return known.tolist()
