"""Writes many episodes of a conversion, in this process or in several."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.workers import Limits
from robocas_ms3.datasets import schema
from robocas_ms3.datasets.pictures.preview import Preview
from robocas_ms3.datasets.writing.players import RecordingPlayer, Request
from robocas_ms3.datasets.writing.pool import do_all
from robocas_ms3.datasets.writing.writer import WrittenEpisode, write_episode


@dataclass(frozen=True)
class Job:
    """What a process needs to know.

    Attributes:
        request: what is converted.
        out: the dataset.
        vectors: embedding (384,) of every text; None: no embeddings.
        sheet: episodes on the contact sheet; None: no previews are made.
        tasks: (number in the dataset, number in the source) of each episode to write.
        limits: of an episode; None: there are none, and one process is this one.
        begun: whether there are episodes already.
    """

    request: Request
    out: Path
    vectors: dict[str, NDArray[np.float32]] | None
    sheet: tuple[int, ...] | None
    tasks: list[tuple[int, int]]
    limits: Limits | None = None
    begun: bool = False


def write_all(job: Job, processes: int) -> Generator[WrittenEpisode, None, None]:
    """Write the job's episodes; gives each when it is done, in any order.

    Raises:
        IncompleteError: episodes can't be written; all others are.
        Exception: what is wrong with all.
    """
    return do_all(
        partial(_Writer, job),
        job.tasks,
        processes,
        job.out,
        limits=job.limits,
        apart=job.limits is not None and job.request.renders,
        name=lambda task: schema.episode_folder(task[0]),
        begun=job.begun,
        fix="The dataset is complete without, and valid; --resume tries again, --leave-out takes it as it is.",
    )


class _Writer:
    """One process's share: keeps what plays the episodes open from one to the next."""

    def __init__(self, job: Job) -> None:
        self.job, self.player = job, RecordingPlayer(job.request)

    def run(self, task: tuple[int, int]) -> WrittenEpisode:
        job, (number, source) = self.job, task
        preview = partial(Preview, job.out, self.player.rate_hz, row=number in (job.sheet or ()))
        return write_episode(
            job.out,
            number,
            self.player,
            source,
            embed=self._embed(),
            open_preview=None if job.sheet is None else preview,
        )

    def _embed(self) -> Callable[[list[str]], NDArray[np.float32]] | None:
        vectors = self.job.vectors
        return None if vectors is None else lambda texts: np.stack([vectors[text] for text in texts])

    def close(self) -> None:
        self.player.close()
