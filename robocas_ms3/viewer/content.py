"""Content of the page for an `EpisodeSource`: table, episodes, images."""

from __future__ import annotations

import re
import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.text import format_object_name
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.episode_source import EpisodeSource, ImageKind
from robocas_ms3.demos.failures import FailedAttempt
from robocas_ms3.demos.recordings.trajectory_json import parse_seed
from robocas_ms3.viewer.damage import convert_damage_errors, join_reasons, read_or_default, read_scene
from robocas_ms3.viewer.episode import collect_facts, make_episode_content, round_values
from robocas_ms3.viewer.episode_table import Failures, Row, describe_failures, list_failed_stages
from robocas_ms3.viewer.images import EncodedImage, encode_jpeg

CAMERA_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,79}")
"""Pattern of the camera names that are shown; names become parts of URLs and paths."""


class Content(ABC):
    """Content of the page; the methods are thread-safe.

    Attributes:
        root: file or folder that the page shows.
    """

    root: Path

    @abstractmethod
    def index(self) -> dict[str, Any]:
        """Return the content of the table, as JSON values."""

    @abstractmethod
    def episode(self, number: int) -> dict[str, Any]:
        """Return the content of the page of a row, as JSON values; raise DatasetError if it is damaged."""

    @abstractmethod
    def rgb(self, number: int, camera: str, step: int) -> EncodedImage:
        """Return an RGB image of a row of the table."""

    @abstractmethod
    def depth(self, number: int, camera: str, step: int) -> NDArray[np.uint16]:
        """Return a depth image (H, W) of a row of the table, uint16 in mm."""


class PageContent(Content):
    """Content of the page for one dataset or trajectory file; the methods are thread-safe.

    Damaged values are omitted. The row of the episode in the table reports them. Subclasses add the content that only
    one format has.

    Args:
        source: reader of the episodes.
        kind: title of the format, such as "LeRobot dataset".
        notes: sentences for the top of the page.
    """

    scene_name = schema.SCENE_FILE
    """Name of the file with the scene of an episode, in messages."""
    entry_name = schema.CONVERSION_FILE
    """Name of the file with the entries of the source, in messages."""

    def __init__(self, source: EpisodeSource, kind: str, notes: Sequence[str] = ()) -> None:
        self.root, self.source, self._kind = source.root, source, kind
        self.failures = Failures.load(self.root if self.root.is_dir() else self.root.parent)
        self._note = " ".join(filter(None, (*notes, self.failures.note)))
        self._reading = threading.Lock()

    def index(self) -> dict[str, Any]:
        """Return the content of the table of episodes, as JSON values.

        The last rows are skipped seeds from ``failures.jsonl``. Arrays are read only for episodes whose length is not
        in the files of the dataset.
        """
        source, split = self.source, self._read_splits()
        lengths, _ = read_or_default(lambda: source.lengths, {})
        found = [self._make_row(number, lengths.get(number, 0), split.get(number, "")) for number in source.numbers]
        rows = [row for row, _ in found]
        rows += self.failures.make_skipped_rows(rows, [env_info for _, env_info in found])
        path = self.root.resolve()
        return {
            "name": path.name if path.is_dir() else f"{path.parent.name}/{path.name}",
            "kind": self._kind,
            "rate_hz": source.rate_hz,
            "cameras": [name for name in source.cameras if CAMERA_NAME.fullmatch(name)],
            "depth": source.has_depth,
            "note": self._note,
            "episodes": [asdict(row) for row in rows],
        }

    def episode(self, number: int) -> dict[str, Any]:
        """Return the content of the page of an episode, as JSON values; raise DatasetError if it is damaged."""
        where = f"{self.root.name}, episode {number}"
        with convert_damage_errors(where):
            scene, _ = self._read_scene(number)  # the table reports errors
            shown = {"facts": collect_facts(scene), **self._make_content(number, scene)}
            if shown["steps"] < 1:
                raise DatasetError("this episode has no steps", where=where)
            return {
                **shown,
                "n": number,
                "times": round_values(np.arange(shown["steps"]) / self.source.rate_hz),
                "plots": [one for one in shown["plots"] if one["series"]],
                "facts": {name: value for name, value in shown["facts"].items() if value not in (None, "", {}, [])},
                "failures": describe_failures(self._find_failures(scene), scene.get("recorded") or {}),
            }

    def rgb(self, number: int, camera: str, step: int) -> EncodedImage:
        """Return an RGB image of an episode."""
        return encode_jpeg(self._image(number, camera, "rgb", step))

    def depth(self, number: int, camera: str, step: int) -> NDArray[np.uint16]:
        """Return a depth image (H, W) of an episode, uint16 in mm."""
        return self._image(number, camera, "depth", step)

    def _make_row(self, number: int, steps: int, split: str) -> tuple[Row, Any]:
        """Return the table row of an episode, and the ``env_info`` of the episode (None if unknown)."""
        scene, wrong = self._read_scene(number)
        entry, wrong_entry = read_scene(lambda: self._read_entry(number), self.entry_name)
        wrong_steps = ""
        if steps < 1:
            steps, wrong_steps = read_or_default(lambda: self.source.episode(number).steps, 0)
        instruction, _ = read_or_default(lambda: self.source.episode(number).instruction, "")
        recorded = scene.get("recorded") or {}
        scene = {**entry, **scene}
        target = scene.get("target") or entry.get("target") or {}
        row = Row(
            number,
            steps=steps,
            instruction=instruction,
            task=scene.get("task") or "",
            object=format_object_name(target.get("asset_id") or "", target.get("name") or ""),
            seed=parse_seed(scene.get("seed")),
            success=scene.get("success"),
            split=split,
            stages=list_failed_stages(self._find_failures(scene), recorded),
            attempts=recorded.get("attempts"),
            damage=join_reasons(wrong, wrong_entry, wrong_steps),
        )
        return row, scene.get("env_info")

    def _read_scene(self, number: int) -> tuple[dict[str, Any], str]:
        """Read the scene of an episode; return the valid values, and a text that describes invalid values."""
        return read_scene(lambda: self.source.episode(number).scene, self.scene_name)

    def _read_entry(self, number: int) -> Any:
        entry = self.source.conversion_entry(number)
        known = ("seed", "success", "target")
        return {key: entry[key] for key in known if key in entry} if isinstance(entry, Mapping) else entry

    def _read_splits(self) -> Mapping[int, str]:
        train, _ = read_or_default(lambda: self.source.split("train"), [])
        val, _ = read_or_default(lambda: self.source.split("val"), [])
        return {**dict.fromkeys(train, "train"), **dict.fromkeys(val, "val")}

    def _find_failures(self, scene: Mapping[str, Any]) -> Sequence[FailedAttempt]:
        return self.failures.find_attempts(parse_seed(scene.get("seed")), scene.get("env_info"))

    def _make_content(self, number: int, scene: Mapping[str, Any]) -> dict[str, Any]:
        """Return the content of an episode as `make_episode_content` does; ``facts`` in it replace the default ones."""
        return make_episode_content(self.source.episode(number).arrays, scene)

    def _image(self, number: int, camera: str, kind: ImageKind, step: int) -> NDArray:
        with convert_damage_errors(f"{self.root.name}, episode {number}"), self._reading:
            episode = self.source.episode(number)
            return episode.rgb(camera, step) if kind == "rgb" else episode.depth(camera, step)
