"""Curves for TensorBoard, in the file as soon as they are told of.

TensorBoard's own writer leaves that to a thread: a full disk would end it with a traceback, and the training later.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robocas_ms3.core.files import make_folder, naming


class Board:
    """Adds a file of events to a folder.

    Args:
        folder: of them.
        first: step from which on what earlier files have is not shown.
    """

    def __init__(self, folder: Path, first: int = 0) -> None:
        from tensorboard.compat.proto import event_pb2, summary_pb2
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._events: Any = event_pb2
        self._summaries: Any = summary_pb2
        make_folder(folder)
        # TensorBoard reads them in the order of their names.
        self._path = folder / f"events.out.tfevents.{int(time.time()):010d}.{len(list(folder.iterdir())):04d}"
        with naming(self._path):
            self._records: Any = RecordWriter(self._path.open("xb"))
        self._write(file_version="brain.Event:2")
        if first:
            log = self._events.SessionLog
            self._write(step=first, session_log=log(status=log.START))

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Write values by name."""
        summary = self._summaries.Summary
        of = [summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        self._write(step=step, summary=summary(value=of))

    def close(self) -> None:
        """Close the file."""
        with naming(self._path):
            self._records.close()

    def _write(self, **event: Any) -> None:
        with naming(self._path):
            self._records.write(self._events.Event(wall_time=time.time(), **event).SerializeToString())
            self._records.flush()
