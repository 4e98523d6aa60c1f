"""Checks a dataset against the schema, and lists every violation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets import schema
from robocas_ms3.datasets.checks.arrays import check_poses, check_shapes, check_values
from robocas_ms3.datasets.checks.info import check_info
from robocas_ms3.datasets.checks.pictures import check_cameras, check_depth, check_pictures
from robocas_ms3.datasets.checks.scene import check_ledger, check_scene, check_settings
from robocas_ms3.datasets.checks.violation import Violation
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.reader import no_dataset
from robocas_ms3.datasets.sources.tolerant import DAMAGED, first_line, is_declared
from robocas_ms3.datasets.writing.output import MARKS
from robocas_ms3.errors import DatasetError


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
    violations: list[Violation] = []
    pictures, wrong = check_settings(root)
    violations += wrong
    loaded: dict[int, dict[str, NDArray]] = {}
    embedded: set[bool] = set()
    sizes: dict[str, tuple[int, int]] = {}  # of each camera, width and height in the first episode
    for done, (number, folder) in enumerate(numbers.items()):
        arrays: dict[str, NDArray] = {}
        violations += _episode(folder, arrays, pictures, sizes)
        loaded[number] = {k: v for k, v in arrays.items() if not k.endswith(("_embs", "_embedding"))}
        if arrays:
            embedded.add("language_embedding" in arrays)
        if on_episode:
            on_episode(done + 1, len(numbers))
    if len(embedded) > 1:
        violations.append(Violation("", "language_embedding", "in all episodes or none", "in some"))
    violations += check_ledger(root, loaded)
    violations += check_info(root, loaded)
    steps = sum(len(arrays["ee_pos"]) for arrays in loaded.values() if np.ndim(arrays.get("ee_pos", 0)))
    return Report(len(numbers), steps, violations)


def _episode(
    folder: Path, arrays: dict[str, NDArray], pictures: Pictures, sizes: dict[str, tuple[int, int]]
) -> Iterator[Violation]:
    """Check one episode; what could be read of its arrays is put into ``arrays``."""
    file = f"{folder.name}/{schema.EPISODE_FILE}"
    try:
        with np.load(folder / schema.EPISODE_FILE, allow_pickle=False) as content:
            for key in content.files:
                try:
                    arrays[key] = content[key]
                except (ValueError, MemoryError) as error:  # pickled, of no such shape, of more numbers than there are
                    found = "a pickled object" if "pickle" in str(error) else first_line(error)
                    yield Violation(file, key, "an array without pickles", found)
    except FileNotFoundError:
        yield Violation(file, "", "this file", "no file")
        return
    except DAMAGED as error:
        yield Violation(file, "", "a numpy archive", first_line(error))
        return
    steps = _count_steps(arrays)
    sound = True
    for violation in check_shapes(file, arrays, steps):
        sound = False
        yield violation
    if sound:
        yield from check_poses(file, arrays)
        yield from check_values(file, arrays)
    yield from check_scene(folder, arrays)
    cameras: dict[str, tuple[NDArray, NDArray]] = {}
    yield from check_cameras(folder, cameras, pictures)
    complete = True
    for violation in check_pictures(folder, steps, pictures, sizes):
        complete = False
        yield violation
    if sound and complete and pictures.depth and len(cameras) == len(pictures.cameras):
        yield from check_depth(folder, arrays, cameras, steps)


def _count_steps(arrays: dict[str, NDArray]) -> int:
    """As ``episode_length`` says where that can be, else as most arrays have."""
    said = arrays.get("episode_length")
    if said is not None and is_declared("episode_length", said) and 0 < said <= schema.MAX_STEPS:
        return int(said)
    lengths = [len(array) for array in arrays.values() if array.ndim]
    return max(set(lengths), key=lengths.count) if lengths else 0
