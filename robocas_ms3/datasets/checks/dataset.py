"""Checks a dataset against the schema, and lists every violation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import arrays as laws
from robocas_ms3.datasets.checks import pictures as seen
from robocas_ms3.datasets.checks.content import SURPLUS, EpisodeContent, read_episode
from robocas_ms3.datasets.checks.info import check_info, read_info
from robocas_ms3.datasets.checks.pictures import Sizes
from robocas_ms3.datasets.checks.scene import check_ledger, check_scene, read_settings
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.reader import no_dataset
from robocas_ms3.datasets.writing.output import MARKS


@dataclass(frozen=True)
class Report:
    """What was found.

    Attributes:
        episodes: how many were looked at.
        steps: how many steps they have.
        violations: every one.
    """

    episodes: int
    steps: int
    violations: list[Violation]

    def as_json(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "valid": not self.violations,
            "episodes": self.episodes,
            "steps": self.steps,
            "violations": [asdict(violation) for violation in self.violations],
        }


def validate(root: str | Path, *, on_episode: Callable[[int, int], None] | None = None) -> Report:
    """Check a dataset.

    Args:
        root: its folder.
        on_episode: called with (done, all) after each episode.

    Raises:
        DatasetError: there is no such folder, or it is something else.
    """
    root = Path(root)
    if not root.is_dir():
        raise DatasetError("no such dataset folder", where=root)
    marked = any((root / mark).exists() for mark in MARKS)
    numbers = {n: folder for folder in sorted(root.iterdir()) if (n := schema.episode_number(folder.name)) is not None}
    if not (numbers or marked) and any(root.iterdir()):
        raise no_dataset(root, "folders episode_0000000, ...")
    settings = read_settings(root)
    pictures, violations = settings.pictures, list(settings.wrong)
    episodes: dict[int, EpisodeContent] = {}
    sizes: Sizes = {}
    embedded: set[bool] = set()
    for done, (number, folder) in enumerate(numbers.items()):
        content = read_episode(folder, pictures)
        sizes = {**seen.sizes_of(content.headers), **sizes}  # those of the first episode count
        violations += check_episode(content, pictures, sizes)
        episodes[number] = content.without_pictures()
        embedded |= {"language_embedding" in content.stored.arrays} if content.stored.arrays else set()
        if on_episode:
            on_episode(done + 1, len(numbers))
    if len(embedded) > 1:
        violations.append(Violation("", "language_embedding", "in all episodes or none", "in some"))
    violations += check_ledger(settings, episodes)
    violations += check_info(read_info(root), episodes)
    lengths = (content.stored.arrays.get("ee_pos", np.zeros(0)) for content in episodes.values())
    return Report(len(numbers), sum(len(positions) for positions in lengths if positions.ndim), violations)


def check_episode(content: EpisodeContent, pictures: Pictures, sizes: Sizes) -> list[Violation]:
    """What is wrong with an episode; parameters of `seen.check_pictures`."""
    stored = content.stored
    form = list(laws.violations_of(stored, laws.FORM))
    turns = [] if form else list(laws.check_units(stored))
    values = [] if form else list(laws.violations_of(stored, laws.CONTENT))
    cameras = list(seen.check_cameras(content, pictures))
    found = [*form, *turns, *values, *check_scene(content), *cameras]
    if "" in stored.unreadable:
        return found  # nobody knows how many pictures there should be
    images = list(seen.check_pictures(content.headers, content.name, pictures, sizes))
    sound = not (form or turns or cameras or any(wrong.found != SURPLUS for wrong in images))
    return [*found, *images, *(seen.check_depth(content, pictures) if pictures.depth and sound else ())]
