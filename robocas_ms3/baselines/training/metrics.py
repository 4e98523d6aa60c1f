"""Metrics of batches, their means, and their log: ``metrics.csv`` and TensorBoard events."""

from __future__ import annotations

import csv
import math
import shutil
import time
from collections.abc import Mapping
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import torch

from robocas_ms3.baselines.training.record import METRICS, TENSORBOARD
from robocas_ms3.core.files import add_path_to_errors, atomic_file, make_folder, open_for_append

_FIRST_COLUMNS = ("step", "split", "epoch", "seconds", "learning_rate")


def read_training_seconds(folder: Path, step: int) -> float | None:
    """Return the wall-clock time in s up to a training step, from the log of a run; None: not in the log."""
    try:
        with (folder / METRICS).open(newline="", encoding="utf-8") as file:
            rows = [row for row in csv.DictReader(file) if _parse_number(row.get("step"), math.inf) <= step]
    except (OSError, ValueError, csv.Error):
        return None
    seconds = [_parse_number(row.get("seconds"), math.nan) for row in rows]
    return next((value for value in reversed(seconds) if math.isfinite(value)), None)


def mean_of_sum_and_count(sum_and_count: torch.Tensor) -> torch.Tensor:
    """Return the mean () of values, from their sum and number (2,); 0 if there are no values."""
    return sum_and_count[0] / sum_and_count[1].clamp(min=1)


def convert_to_sum_and_count(metric: torch.Tensor, samples: int) -> torch.Tensor:
    """Return the sum and the number of values of a batch metric, float64 (2,).

    metric: the mean over the ``samples`` of the batch (), or already sum and number of values (2,).
    """
    metric = metric.detach().double()
    return metric if metric.ndim else torch.stack([metric * samples, torch.full_like(metric, samples)])


def compute_means(sums: Mapping[str, torch.Tensor]) -> dict[str, float]:
    """Return the mean of each metric; NaN for a metric without values.

    sums: tensors (2,) of the sum and the number of values, by metric.
    """
    return {name: float(mean_of_sum_and_count(value)) if value[1] else math.nan for name, value in sums.items()}


class MetricsLog:
    """Log of metrics in a run folder: ``metrics.csv`` and TensorBoard events.

    Args:
        folder: folder of the run.
        step: step from which the run continues; lines of later steps, which a killed process wrote, are removed.

    Attributes:
        seconds: training time up to ``step``.
    """

    def __init__(self, folder: Path, step: int) -> None:
        self.seconds = 0.0
        self._path = folder / METRICS
        self._columns: list[str] = []
        self._written: set[tuple[int, str]] = set()
        if self._path.is_file():
            self._remove_lines_after(step)
        if not step:
            shutil.rmtree(folder / TENSORBOARD, ignore_errors=True)
        self._tensorboard = TensorBoardWriter(folder / TENSORBOARD, step + 1 if step else 0)

    def has_line(self, step: int, split: str) -> bool:
        """Return whether the log had a line of this step and split when it was opened."""
        return (step, split) in self._written

    def add(self, step: int, split: str, schedule: Mapping[str, float], metrics: Mapping[str, float]) -> None:
        """Write the metrics of a step as a line of the CSV file and as a TensorBoard event.

        schedule: ``epoch``, ``seconds`` and ``learning_rate`` of the step.
        """
        row = {"step": step, "split": split, **schedule, **metrics}
        is_first = not self._columns
        if is_first:
            self._columns = [*_FIRST_COLUMNS, *metrics]
        with add_path_to_errors(self._path), TextIOWrapper(open_for_append(self._path), "utf-8", newline="") as file:
            writer = csv.DictWriter(file, self._columns, extrasaction="ignore", lineterminator="\n")
            if is_first:
                writer.writeheader()
            writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})
        shown = {**metrics, "learning_rate": schedule["learning_rate"]}
        self._tensorboard.add(step, {f"{split}/{key}": value for key, value in shown.items() if math.isfinite(value)})

    def close(self) -> None:
        self._tensorboard.close()

    def _remove_lines_after(self, step: int) -> None:
        with self._path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        whole = [row for row in rows if None not in row.values()]  # a killed process may have written half a line
        kept = [row for row in whole if _parse_number(row["step"], math.inf) <= step]
        self._written = {(int(row["step"]), row["split"]) for row in kept}
        self._columns = list(rows[0]) if rows else []
        if kept:
            self.seconds = _parse_number(kept[-1]["seconds"], 0.0)
        with atomic_file(self._path) as tmp, tmp.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self._columns, extrasaction="ignore", lineterminator="\n")
            if self._columns:
                writer.writeheader()
            writer.writerows(kept)


class TensorBoardWriter:
    """Writer of TensorBoard events that raises errors at once; TensorBoard's own writer has a thread.

    first_step: if above 0, viewers discard events of this step and later ones from earlier files in the folder.
    """

    def __init__(self, folder: Path, first_step: int = 0) -> None:
        from tensorboard.compat.proto import event_pb2, summary_pb2
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._events: Any = event_pb2
        self._summaries: Any = summary_pb2
        make_folder(folder)
        # TensorBoard reads the files in the order of their names
        self._path = folder / f"events.out.tfevents.{int(time.time()):010d}.{len(list(folder.iterdir())):04d}"
        with add_path_to_errors(self._path):
            self._records: Any = RecordWriter(self._path.open("xb"))
        self._write(file_version="brain.Event:2")
        if first_step:
            log = self._events.SessionLog
            self._write(step=first_step, session_log=log(status=log.START))

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Write an event of a training step with one scalar per name."""
        summary = self._summaries.Summary
        scalars = [summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        self._write(step=step, summary=summary(value=scalars))

    def close(self) -> None:
        with add_path_to_errors(self._path):
            self._records.close()

    def _write(self, **event: Any) -> None:
        with add_path_to_errors(self._path):
            self._records.write(self._events.Event(wall_time=time.time(), **event).SerializeToString())
            self._records.flush()


def _parse_number(text: Any, default: float) -> float:
    """Parse a number; return the default if the text is not a number."""
    try:
        return float(text)
    except (TypeError, ValueError):
        return default
