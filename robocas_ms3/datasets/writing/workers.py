"""Writes many episodes of a trajectory, in this process or in several."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.datasets.pictures.preview import Preview
from robocas_ms3.datasets.pictures.stored import Pictures
from robocas_ms3.datasets.sources.provenance import scene_record
from robocas_ms3.datasets.writing.pool import do_all
from robocas_ms3.datasets.writing.timing import Timing
from robocas_ms3.datasets.writing.writer import FrameSource, WrittenEpisode, write_episode
from robocas_ms3.recordings.environment import RecordedEnv
from robocas_ms3.recordings.reading import TrajectoryFile

OpenSource = Callable[[RecordedEnv, str, Pictures], FrameSource]
"""Makes a frame source from what was recorded in, control mode and what is to be rendered."""


@dataclass(frozen=True)
class Job:
    """What a process needs to know.

    Attributes:
        trajectory: the HDF5 file.
        pack: of its objects, instead of what it names.
        out: the dataset.
        stride: control steps a dataset step.
        rate_hz: of the dataset.
        pictures: which ones.
        vectors: embedding (384,) of every text; None: no embeddings.
        open_source: makes what shows the states.
        sheet: episodes on the contact sheet; None: no previews are made.
        tasks: (number in the dataset, index in the trajectory) of each episode to write.
    """

    trajectory: Path
    pack: str | Path | None
    out: Path
    stride: int
    rate_hz: float
    pictures: Pictures
    vectors: dict[str, NDArray[np.float32]] | None
    open_source: OpenSource
    sheet: tuple[int, ...] | None
    tasks: list[tuple[int, int]]


def write_all(job: Job, processes: int) -> Generator[WrittenEpisode, None, None]:
    """Write the job's episodes; gives each when it is done, in any order.

    Raises:
        DatasetError: an episode can't be written, or a process died.
    """
    return do_all(partial(_Writer, job), job.tasks, processes, job.out)


class _Writer:
    """One process's share: keeps the trajectory and the environment open from one episode to the next."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.file = TrajectoryFile(job.trajectory, pack=job.pack)
        self.source: FrameSource | None = None
        self.control_mode = ""

    def do(self, task: tuple[int, int]) -> WrittenEpisode:
        job, (number, index), timing = self.job, task, Timing()
        with timing.measure("total"), timing.measure("load"):
            recording = self.file.recording(index)
            if self.source is None or recording.control_mode != self.control_mode:
                self._close_source()
                self.source = job.open_source(self.file.env, recording.control_mode, job.pictures)
                self.control_mode = recording.control_mode
        return write_episode(
            job.out,
            number,
            recording,
            self.source,
            stride=job.stride,
            pictures=job.pictures,
            describe=lambda scene: scene_record(self.file, index, recording, scene, job.rate_hz),
            embed=self._embed(),
            open_preview=None if job.sheet is None else partial(Preview, job.out, job.rate_hz, row=number in job.sheet),
            timing=timing,
        )

    def _embed(self) -> Callable[[list[str]], NDArray[np.float32]] | None:
        vectors = self.job.vectors
        return None if vectors is None else lambda texts: np.stack([vectors[text] for text in texts])

    def _close_source(self) -> None:
        if self.source is not None:
            self.source.close()
            self.source = None

    def close(self) -> None:
        self._close_source()
        self.file.close()
