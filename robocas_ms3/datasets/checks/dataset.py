"""Checks a RoboCAS folder against the schema, and lists every violation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks import arrays as laws
from robocas_ms3.datasets.checks.info import check_info
from robocas_ms3.datasets.checks.pictures import SURPLUS, Sizes, check_cameras, check_depth, check_images
from robocas_ms3.datasets.checks.scene import check_ledger, check_values, read_settings
from robocas_ms3.datasets.checks.violation import Violation, read_object
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.reader import no_dataset
from robocas_ms3.datasets.sources.tolerant import EpisodeArrays, read_arrays
from robocas_ms3.datasets.writing.plan import MARKS

_EMBEDDINGS = {spec.name for spec in schema.EPISODE_INFO if spec.embedding}


@dataclass(frozen=True)
class Report:
    """Result of a check.

    Attributes:
        episodes: number of episodes checked.
        steps: number of their steps.
        violations: all of them.
    """

    episodes: int
    steps: int
    violations: list[Violation]

    def as_json(self) -> dict[str, Any]:
        """Return the report of ``--json``."""
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
    settings, pictures, violations = read_settings(root)
    episodes: dict[int, tuple[EpisodeArrays, dict[str, Any]]] = {}
    sizes: Sizes = {}
    embedded: set[bool] = set()
    for done, (number, folder) in enumerate(numbers.items(), start=1):
        stored = read_arrays(folder / schema.EPISODE_FILE)
        scene, wrong = read_object(root, f"{folder.name}/{schema.SCENE_FILE}")
        wrong = wrong or check_values(scene, f"{folder.name}/{schema.SCENE_FILE}")
        violations += [*wrong, *check_episode(folder, stored, pictures, sizes)]
        embedded |= {"language_embedding" in stored.arrays} if stored.arrays else set()
        small = {key: array for key, array in stored.arrays.items() if key not in _EMBEDDINGS}
        episodes[number] = replace(stored, arrays=small), scene
        if on_episode:
            on_episode(done, len(numbers))
    if len(embedded) > 1:
        violations.append(Violation("", "language_embedding", "in all episodes or none", "in some"))
    violations += check_ledger(settings, episodes)
    violations += check_info(root, {number: stored.arrays for number, (stored, _) in episodes.items()})
    positions = (stored.arrays.get("ee_pos") for stored, _ in episodes.values())
    return Report(len(numbers), sum(len(found) for found in positions if found is not None and found.ndim), violations)


def check_episode(folder: Path, stored: EpisodeArrays, pictures: Pictures, sizes: Sizes) -> list[Violation]:
    """Check the arrays, cameras and images of an episode; see `check_images`."""
    wrong = list(laws.violations_of(stored, laws.FORM))
    if not wrong:
        wrong = list(laws.check_units(stored))
        values = list(laws.violations_of(stored, laws.CONTENT))
    else:
        values = []
    wrong += check_cameras(folder, pictures)
    if "" in stored.unreadable:
        return wrong  # the number of images is unknown
    images = list(check_images(folder, pictures, stored.steps, sizes))
    if pictures.depth and not wrong and all(image.found == SURPLUS for image in images):
        images += check_depth(folder, stored, pictures)
    return [*wrong, *values, *images]
