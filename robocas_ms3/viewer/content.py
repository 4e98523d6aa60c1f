"""What the page shows of an `EpisodeSource`: the table, an episode, its pictures."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.core.words import called
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.sources.protocol import EpisodeSource, Kind
from robocas_ms3.demos.ledger import Failure
from robocas_ms3.demos.recordings.seeds import one_seed
from robocas_ms3.viewer import damage
from robocas_ms3.viewer.arrays import facts_of, show_arrays
from robocas_ms3.viewer.damage import attempt, readable, together
from robocas_ms3.viewer.failures import Failures, describe, stages
from robocas_ms3.viewer.parts import Picture, make_index, rounded, row
from robocas_ms3.viewer.pictures import encode_jpeg


class PageContent:
    """Episodes as the page shows them: what is damaged is left out, and its row says so. For several threads at once.

    What a format adds is in a subclass; those of other packages are shown by what `EpisodeSource` has alone.
    """

    scene_name = schema.SCENE_FILE
    """Where ``scene`` of an episode is from, for people."""
    entry_name = schema.CONVERSION_FILE
    """Where ``entry`` of the source is from."""

    def __init__(
        self, source: EpisodeSource, kind: str, *, notes: Sequence[str] = (), split: Mapping[int, str] | None = None
    ) -> None:
        """Show a source.

        Args:
            source: where the episodes are from.
            kind: its format, for people.
            notes: what people should know of it.
            split: side of each episode that is on one; None: as the source says.
        """
        self.root, self.source, self._kind, self._split = source.root, source, kind, split
        self.failures = Failures.read(self.root if self.root.is_dir() else self.root.parent)
        self._note = " ".join(filter(None, (*notes, self.failures.note)))
        self._reading = threading.Lock()

    def index(self) -> dict[str, Any]:
        """Everything the table needs, see `make_index`; arrays are read only where the overviews are silent.

        Seeds without an episode, from ``failures.jsonl``, come last.
        """
        source, split = self.source, self._sides()
        lengths, _ = attempt(lambda: source.lengths, {})
        found = [self._row(number, lengths.get(number, 0), split.get(number, "")) for number in source.numbers]
        rows = [row for row, _ in found]
        rows += self.failures.given_up(rows, [env_info for _, env_info in found])
        return make_index(self.root, self._kind, source.rate_hz, source.cameras, source.has_depth, rows, self._note)

    def episode(self, number: int) -> dict[str, Any]:
        """All of an episode but its pictures.

        Raises:
            DatasetError: there is none of this number, or it can't be read.
        """
        where = f"{self.root.name}, episode {number}"
        with readable(where):
            scene, _ = self._scene(number)  # the table says what is wrong
            shown = {"facts": facts_of(scene), **self._show(number, scene)}
            if shown["steps"] < 1:
                raise DatasetError("this episode has no steps", where=where)
            return {
                "n": number,
                "instruction": shown["instruction"],
                "steps": shown["steps"],
                "times": rounded(np.arange(shown["steps"]) / self.source.rate_hz),
                "subgoals": shown["subgoals"],
                "plots": [one for one in shown["plots"] if one["series"]],
                "trace": shown["trace"],
                "facts": {name: value for name, value in shown["facts"].items() if value not in (None, "", {}, [])},
                "failures": describe(self._failures(scene), scene.get("recorded") or {}),
            }

    def rgb(self, number: int, camera: str, step: int) -> Picture:
        """A picture, as it is stored where that is an encoded one.

        Raises:
            DatasetError: there is none.
        """
        return encode_jpeg(self._picture(number, camera, "rgb", step))

    def depth(self, number: int, camera: str, step: int) -> NDArray[np.uint16]:
        """(H, W) mm, 0 = nothing.

        Raises:
            DatasetError: there is none.
        """
        return self._picture(number, camera, "depth", step)

    def _row(self, number: int, steps: int, split: str) -> tuple[dict[str, Any], Any]:
        """Its row, and the environment it is of, as far as that is known."""
        scene, wrong = self._scene(number)
        entry, wrong_entry = self._entry(number)
        wrong_steps = ""
        if steps < 1:
            steps, wrong_steps = attempt(lambda: self.source.episode(number).steps, 0)
        instruction, _ = attempt(lambda: self.source.episode(number).instruction, "")
        recorded = scene.get("recorded") or {}
        scene = {**entry, **scene}
        target = scene.get("target") or entry.get("target") or {}
        shown = row(
            number,
            steps=steps,
            instruction=instruction,
            task=scene.get("task") or "",
            target=called(target.get("asset_id") or "", target.get("name") or ""),
            seed=one_seed(scene.get("seed")),
            success=scene.get("success"),
            split=split,
            stages=stages(self._failures(scene), recorded),
            attempts=recorded.get("attempts"),
            damage=together(wrong, wrong_entry, wrong_steps),
        )
        return shown, scene.get("env_info")

    def _scene(self, number: int) -> tuple[dict[str, Any], str]:
        """How an episode was made, without what is wrong, and that in words."""
        return damage.scene(lambda: self.source.episode(number).scene, self.scene_name)

    def _entry(self, number: int) -> tuple[dict[str, Any], str]:
        """What the dataset says of it where its scene is silent."""

        def read() -> Any:
            entry = self.source.entry(number)
            known = ("seed", "success", "target")
            return {key: entry[key] for key in known if key in entry} if isinstance(entry, Mapping) else entry

        return damage.scene(read, self.entry_name)

    def _sides(self) -> Mapping[int, str]:
        if self._split is not None:
            return self._split
        train, _ = attempt(lambda: self.source.split("train"), [])
        val, _ = attempt(lambda: self.source.split("val"), [])
        return {**dict.fromkeys(train, "train"), **dict.fromkeys(val, "val")}

    def _failures(self, scene: Mapping[str, Any]) -> Sequence[Failure]:
        """Known of its seed in its environment."""
        return self.failures.of_seed(one_seed(scene.get("seed")), scene.get("env_info"))

    def _show(self, number: int, scene: Mapping[str, Any]) -> dict[str, Any]:
        """What an episode of this scene is on the page, see `show_motion`; ``facts`` for people where they differ."""
        return show_arrays(self.source.episode(number).arrays, scene)

    def _picture(self, number: int, camera: str, kind: Kind, step: int) -> NDArray:
        """A picture, decoded."""
        with readable(f"{self.root.name}, episode {number}"), self._reading:
            episode = self.source.episode(number)
            return episode.rgb(camera, step) if kind == "rgb" else episode.depth(camera, step)
