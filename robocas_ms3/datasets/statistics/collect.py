"""What is in a dataset: lengths, objects, layouts, instructions, actions, sub-goals, counted in one pass."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import count_of
from robocas_ms3.datasets.actions import ACTION_ARRAYS, ACTION_NAMES
from robocas_ms3.datasets.formats import open_source
from robocas_ms3.datasets.statistics.described import counted, described, histogram, rounded
from robocas_ms3.datasets.statistics.facts import Facts, facts_of
from robocas_ms3.datasets.statistics.layout_map import LayoutMap, layout_map
from robocas_ms3.datasets.training.sample_arrays import checked_actions

STILL = (1e-3, np.deg2rad(0.5))  # m and rad a step below which the gripper counts as standing still


@dataclass
class Stats:
    """Everything counted.

    Attributes:
        path: of the dataset.
        rate_hz: steps a second.
        split: episodes of each side.
        lengths: task -> T of each of its episodes.
        success: of the episodes: ``true``, ``false``, ``unknown``.
        configs: episodes of each configuration.
        names: id -> name of the objects.
        objects: id -> in how many episodes it took part (copies count once).
        targets: id -> of how many it was the target.
        layouts: by configuration.
        instructions, templates, relations: episodes of each.
        actions: (N, 7) all of them.
        subgoals: type -> steps of each.
        gripper_changes: commands to open or close in each episode.
    """

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
        """How many."""
        return sum(map(len, self.lengths.values()))

    @property
    def steps(self) -> int:
        """All of them."""
        return sum(map(sum, self.lengths.values()))

    def summary(self) -> str:
        """One line."""
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
        """``stats.json``: counts by descending count, lengths in steps, durations in s, positions in m."""
        motion = self.actions[:, :6]
        still = (np.linalg.norm(motion[:, :3], axis=1) < STILL[0]) & (
            np.abs(motion[:, 3:]).max(1, initial=0) < STILL[1]
        )
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
            "still": rounded(float(still.mean())) if len(still) else None,
            "gripper_changes": described(self.gripper_changes),
            "subgoals": {
                kind: {**described(np.array(steps) / self.rate_hz), "share": rounded(sum(steps) / self.steps)}
                for kind, steps in sorted(self.subgoals.items())
            },
        }


def collect(
    path: Path | str, *, rate_hz: float | None = None, on_episode: Callable[[int, int], None] | None = None
) -> Stats:
    """Read a dataset or a trajectory file (failed episodes too), without pictures.

    Args:
        path: of it.
        rate_hz: of a trajectory's steps; default 5.
        on_episode: called with how many are done, of how many.

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
        _count(stats, facts)
        for goal in episode.goals:
            stats.subgoals[goal.goal_type].append(goal.last - goal.first + 1)
        moves = checked_actions(episode.read(ACTION_ARRAYS), f"{source.root}, episode {number}")[:-1]
        actions.append(moves)
        stats.gripper_changes.append(int(np.count_nonzero(np.diff(moves[:, 6]))))
        stats.lengths[facts.task].append(source.lengths[number])
        if len(facts.positions):
            places[facts.config].append(facts)
        if on_episode:
            on_episode(done, len(numbers))
    if actions:
        stats.actions = np.concatenate(actions)
    stats.layouts = {config: layout_map(parts) for config, parts in places.items()}
    return stats


def _count(stats: Stats, facts: Facts) -> None:
    stats.success[{True: "true", False: "false", None: "unknown"}[facts.success]] += 1
    stats.configs[facts.config] += 1
    stats.names.update(facts.names)
    stats.objects.update(set(facts.object_ids))
    if facts.target_id:
        stats.targets[facts.target_id] += 1
    stats.instructions[facts.instruction] += 1
    for counter, value in ((stats.templates, facts.template), (stats.relations, facts.relation)):
        if value:
            counter[value] += 1
