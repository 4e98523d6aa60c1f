"""What a training says of itself: a CSV, the same for TensorBoard, and both cut back where a run goes on."""

from __future__ import annotations

import csv
import math
import shutil
from collections.abc import Mapping
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from robocas_ms3.baselines.board import Board
from robocas_ms3.baselines.runs import BOARD, METRICS
from robocas_ms3.core.files import naming, open_for_append, replacing

_FIRST = ("step", "split", "epoch", "seconds", "learning_rate")


class MetricsLog:
    """Appends lines to ``metrics.csv`` and events to ``tensorboard/``.

    Args:
        folder: of the run.
        step: steps done before; lines after that are of a training that was broken off, and go.
    """

    def __init__(self, folder: Path, step: int) -> None:
        self._path = folder / METRICS
        self._columns: list[str] = []
        self._had: set[tuple[int, str]] = set()
        self.seconds = 0.0
        """Spent up to ``step`` by those before."""
        if self._path.is_file():
            self._cut(step)
        if not step:
            shutil.rmtree(folder / BOARD, ignore_errors=True)
        self._board = Board(folder / BOARD, step + 1 if step else 0)

    def has(self, step: int, split: str) -> bool:
        """Whether those before wrote that line."""
        return (step, split) in self._had

    def add(self, step: int, split: str, about: Mapping[str, float], metrics: Mapping[str, float]) -> None:
        """Write a line.

        Args:
            step: steps done.
            split: ``train`` (means since the last line) or ``val``.
            about: epoch, seconds and learning rate.
            metrics: by name.
        """
        row = {"step": step, "split": split, **about, **metrics}
        new = not self._columns
        if new:
            self._columns = [*_FIRST, *metrics]
        with naming(self._path), TextIOWrapper(open_for_append(self._path), "utf-8", newline="") as file:
            lines = csv.DictWriter(file, self._columns, extrasaction="ignore", lineterminator="\n")
            if new:
                lines.writeheader()
            lines.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})
        shown = {**metrics, "learning_rate": about["learning_rate"]}
        self._board.add(step, {f"{split}/{key}": value for key, value in shown.items() if math.isfinite(value)})

    def close(self) -> None:
        """End it."""
        self._board.close()

    def _cut(self, step: int) -> None:
        with self._path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        whole = [row for row in rows if None not in row.values()]  # a kill may have cut off the last
        kept = [row for row in whole if _number(row["step"]) <= step]
        self._had = {(int(row["step"]), row["split"]) for row in kept}
        self._columns = list(rows[0]) if rows else []
        if kept:
            self.seconds = _number(kept[-1]["seconds"], 0.0)
        with replacing(self._path) as tmp, tmp.open("w", newline="", encoding="utf-8") as file:
            lines = csv.DictWriter(file, self._columns, extrasaction="ignore", lineterminator="\n")
            if self._columns:
                lines.writeheader()
            lines.writerows(kept)


def _number(text: Any, missing: float = math.inf) -> float:
    """A number of a line, which a kill may have cut off."""
    try:
        return float(text)
    except (TypeError, ValueError):
        return missing
