"""What is in a dataset: lengths, objects, layouts, instructions, actions, sub-goals, counted in one pass."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets.actions import ACTION_ARRAYS, ACTION_NAMES
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.statistics.facts import Array, Facts, facts_of
from robocas_ms3.datasets.training.sample_arrays import checked_actions

NOOP = (1e-3, np.deg2rad(0.5))  # m and rad per step below which the gripper counts as standing still
BINS = 41  # of histograms; odd, so that standing still has a bin of its own
CELL = 0.05  # m
MARGIN = 0.3  # m around the region that layouts are sampled in; heaps slide out of it


@dataclass(frozen=True)
class LayoutMap:
    """Where objects stood at the beginning of the episodes of one configuration, m.

    Attributes:
        frame: of the positions: a piece of furniture's, or the world's.
        region: [min_xy, max_xy] that layouts are sampled in; None: not known.
        counts: (nx, ny) objects in each cell.
        outside: objects farther from the region than ``MARGIN``, in no cell.
    """

    frame: str
    region: list[list[float]] | None
    x_edges: Array
    y_edges: Array
    counts: NDArray[np.int64]
    outside: int
    targets: Array
    episodes: int

    @property
    def coverage(self) -> float | None:
        """Fraction of the region's cells that an object's centre was ever in; None without a region."""
        if self.region is None:
            return None
        (x0, y0), (x1, y1) = self.region
        x, y = (self.x_edges[:-1] + self.x_edges[1:]) / 2, (self.y_edges[:-1] + self.y_edges[1:]) / 2
        inside = np.outer((x > x0) & (x < x1), (y > y0) & (y < y1))
        return float(np.mean(self.counts[inside] > 0)) if inside.any() else None

    def as_json(self) -> dict[str, Any]:
        return {
            "frame": self.frame,
            "region": self.region,
            "episodes": self.episodes,
            "objects": int(self.counts.sum()) + self.outside,
            "outside": self.outside,
            "coverage": _rounded(self.coverage),
            "x_edges": _rounded(self.x_edges),
            "y_edges": _rounded(self.y_edges),
            "counts": self.counts.tolist(),
            "targets": _rounded(self.targets),
        }


def layout_map(parts: list[Facts]) -> LayoutMap:
    """Return the heat map of one configuration, in the frame of its furniture where that is known for all."""
    surface = parts[0].surface
    if surface is None or any(part.surface != surface for part in parts):
        surface = None
    placed = [part.positions if surface is None else surface.place(part.positions) for part in parts]
    points = np.concatenate(placed)
    targets = [xy[part.target_index] for part, xy in zip(parts, placed, strict=True) if part.target_index is not None]
    region = surface.region if surface else None
    low, high = np.asarray(region) if region else (points.min(0), points.max(0))
    near = points[((points >= low - MARGIN) & (points <= high + MARGIN)).all(axis=1)]
    x_edges, y_edges = (_edges(low[axis], high[axis], near[:, axis]) for axis in (0, 1))
    counts = np.histogramdd(near, bins=(x_edges, y_edges))[0].astype(np.int64)
    frame = surface.label if surface else "world"
    outside = len(points) - int(counts.sum())
    return LayoutMap(frame, region, x_edges, y_edges, counts, outside, np.array(targets).reshape(-1, 2), len(parts))


def _edges(low: float, high: float, points: Array) -> Array:
    """Return edges of equal cells of about ``CELL`` that divide [low, high], and as many more as the points need."""
    cell = (high - low) / max(1, round((high - low) / CELL)) if high - low > CELL / 2 else CELL
    before = np.ceil((low - points.min(initial=low)) / cell - 1e-9)
    after = np.ceil((points.max(initial=high) - low) / cell - 1e-9)
    return low + cell * np.arange(-int(before), max(1, int(after)) + 1, dtype=np.float64)


@dataclass
class Stats:
    """Counts of a dataset: episodes of each kind, T of the episodes of each task, steps of each type of sub-goal."""

    path: Path
    rate_hz: float
    split: dict[str, int]
    lengths: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    success: Counter[str] = field(default_factory=Counter)
    configs: Counter[str] = field(default_factory=Counter)
    names: dict[str, str] = field(default_factory=dict)
    objects: Counter[str] = field(default_factory=Counter)
    targets: Counter[str] = field(default_factory=Counter)
    layouts: dict[str, LayoutMap] = field(default_factory=dict)
    instructions: Counter[str] = field(default_factory=Counter)
    templates: Counter[str] = field(default_factory=Counter)
    relations: Counter[str] = field(default_factory=Counter)
    actions: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 7), np.float32))
    subgoals: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    gripper_changes: list[int] = field(default_factory=list)

    @property
    def episodes(self) -> int:
        return sum(map(len, self.lengths.values()))

    @property
    def steps(self) -> int:
        return sum(map(sum, self.lengths.values()))

    def add(self, facts: Facts) -> None:
        self.success[{True: "true", False: "false", None: "unknown"}[facts.success]] += 1
        self.configs[facts.config] += 1
        self.names.update(facts.names)
        self.objects.update(set(facts.object_ids))
        self.instructions[facts.instruction] += 1
        for counter, value in (
            (self.targets, facts.target_id),
            (self.templates, facts.template),
            (self.relations, facts.relation),
        ):
            if value:
                counter[value] += 1

    def summary(self) -> str:
        tasks = ", ".join(f"{task} {len(lengths)}" for task, lengths in sorted(self.lengths.items()))
        covered = [share for share in (one.coverage for one in self.layouts.values()) if share is not None]
        parts = [
            f"{count_of(self.episodes, 'episode')} ({tasks})",
            f"{count_of(self.steps, 'step')} ({self.steps / self.rate_hz / 60:.1f} min at {self.rate_hz:g} Hz)",
            f"{count_of(len(self.targets), 'target')} of {count_of(len(self.objects), 'object')}",
            count_of(len(self.instructions), "instruction"),
        ]
        if covered:
            low, high = f"{min(covered):.0%}", f"{max(covered):.0%}"
            parts.append("layouts cover " + (low if low == high else f"{low} to {high}") + " of the surface")
        return ", ".join(parts)

    def as_json(self) -> dict[str, Any]:
        """Return ``stats.json``: counts by descending count, lengths in steps, durations in s, positions in m."""
        shift, turn = np.linalg.norm(self.actions[:, :3], axis=1), np.abs(self.actions[:, 3:6]).max(1, initial=0)
        noop = (shift < NOOP[0]) & (turn < NOOP[1])
        return {
            "path": str(self.path),
            "rate_hz": self.rate_hz,
            "episodes": self.episodes,
            "steps": self.steps,
            "split": self.split,
            "success": dict(self.success),
            "configs": counted(self.configs),
            "lengths": {task: described(lengths) for task, lengths in sorted(self.lengths.items())},
            "objects": {
                asset: {
                    "name": self.names.get(asset, asset),
                    "episodes": self.objects[asset],
                    "target": self.targets[asset],
                }
                for asset in counted(self.objects | self.targets)
            },
            "layouts": {name: layout.as_json() for name, layout in sorted(self.layouts.items())},
            "instructions": counted(self.instructions),
            "templates": counted(self.templates),
            "relations": counted(self.relations),
            "actions": {
                name: {**described(column), **histogram(column)}
                for name, column in zip(ACTION_NAMES, self.actions.T, strict=True)
            },
            "still": _rounded(float(noop.mean())) if len(noop) else None,
            "gripper_changes": described(self.gripper_changes),
            "subgoals": {
                kind: {**described(np.array(steps) / self.rate_hz), "share": _rounded(sum(steps) / self.steps)}
                for kind, steps in sorted(self.subgoals.items())
            },
        }


def collect(
    path: Path | str, *, rate_hz: float | None = None, on_episode: Callable[[int, int], None] | None = None
) -> Stats:
    """Read a dataset, or a trajectory with failed episodes, without images; ``on_episode`` is called with (done, all).

    Raises:
        DatasetError: it can't be read.
    """
    source = open_source(path, rate_hz=rate_hz, include_failed=True)
    numbers = source.split("all")
    if not numbers:
        raise DatasetError("no episodes to count", where=path)
    stats = Stats(source.root, source.rate_hz, {side: len(source.split(side)) for side in ("train", "val")})
    actions: list[NDArray[np.float32]] = []
    places: dict[str, list[Facts]] = defaultdict(list)
    for done, number in enumerate(numbers, start=1):
        episode = source.episode(number)
        facts = facts_of(episode)
        stats.add(facts)
        for goal in episode.goals:
            stats.subgoals[goal.goal_type].append(goal.last - goal.first + 1)
        actions.append(checked_actions(episode.read(ACTION_ARRAYS), f"{source.root}, episode {number}")[:-1])
        stats.gripper_changes.append(int(np.count_nonzero(np.diff(actions[-1][:, 6]))))
        stats.lengths[facts.task].append(source.lengths[number])
        if len(facts.positions):
            places[facts.config].append(facts)
        if on_episode:
            on_episode(done, len(numbers))
    stats.actions = np.concatenate(actions)
    stats.layouts = {config: layout_map(parts) for config, parts in places.items()}
    return stats


def counted(counter: Mapping[str, int]) -> dict[str, int]:
    """Return counts, the most frequent first, then by name."""
    return dict(sorted(counter.items(), key=lambda item: (-item[1], item[0])))


def described(values: Iterable[float] | NDArray) -> dict[str, Any]:
    array = np.asarray(list(values) if not isinstance(values, np.ndarray) else values, dtype=np.float64)
    if not len(array):
        return {"count": 0}
    low, p1, p10, median, p90, p99, high = np.percentile(array, [0, 1, 10, 50, 90, 99, 100])
    found = dict(mean=array.mean(), std=array.std(), min=low, p1=p1, p10=p10, median=median, p90=p90, p99=p99, max=high)
    return {"count": len(array), **{key: _rounded(float(value)) for key, value in found.items()}}


def histogram(values: NDArray) -> dict[str, Any]:
    """Return counts over equal bins, symmetric about 0; two bins for values that are 0 or 1."""
    if not len(values):
        return {"edges": [], "counts": []}
    reach = float(np.abs(values).max()) or 1.0
    edges = np.array([-0.5, 0.5, 1.5]) if set(np.unique(values)) <= {0, 1} else np.linspace(-reach, reach, BINS + 1)
    return {"edges": _rounded(edges), "counts": np.histogram(values, edges)[0].tolist()}


def _rounded(value: Any) -> Any:
    return None if value is None else np.round(value, 6).tolist()
