"""Writing of the episodes of a conversion, in this process or in several worker processes."""

from __future__ import annotations

import errno
import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocas_ms3.core.errors import DatasetError, IncompleteDatasetError, MissingExtraError
from robocas_ms3.core.files import atomic_folder
from robocas_ms3.core.output_folder import OutputFolder
from robocas_ms3.core.remote_errors import RemoteError
from robocas_ms3.core.text import format_count, format_error
from robocas_ms3.core.workers import NO_LIMITS, WorkerPool, use_one_torch_thread
from robocas_ms3.datasets.conversion.conversion_input import ConversionInput, open_input, require_complete_arrays
from robocas_ms3.datasets.conversion.settings import ConversionSettings, WrittenEpisode
from robocas_ms3.datasets.schema import episode_folder
from robocas_ms3.datasets.sources.episode_source import SourceEpisode, StepImages

_MAX_FIRST_FAILURES = 3  # without any success; then all episodes are assumed to fail
_MAX_LISTED = 5  # failures in an error message
_log = logging.getLogger(__name__)

Task = tuple[int, int]
"""Number of an episode in the dataset, and in the source."""


@dataclass(frozen=True)
class InputEpisode:
    """Episode to write: its number in the dataset, its source episode, and its checked arrays."""

    number: int
    episode: SourceEpisode
    arrays: dict[str, NDArray]
    conversion_input: ConversionInput


class EpisodeWriter(ABC):
    """Writer of the episodes of one format; picklable."""

    @abstractmethod
    def folder(self, number: int) -> Path:
        """Return the folder of an episode, which is created atomically."""

    @abstractmethod
    def write_files(
        self, folder: Path, wanted: InputEpisode, frames: Generator[StepImages, None, None]
    ) -> NDArray[np.uint8] | None:
        """Write an episode into a folder; return its row of the contact sheet, if any."""

    def write(self, number: int, conversion_input: ConversionInput, source: int) -> WrittenEpisode:
        """Write episode ``source`` of the input as episode ``number`` of the dataset."""
        with atomic_folder(self.folder(number), sync=True) as folder:
            episode = conversion_input.source.episode(source)
            wanted = InputEpisode(number, episode, require_complete_arrays(episode), conversion_input)
            with closing(conversion_input.frames(episode)) as frames:
                row = self.write_files(folder, wanted, frames)
            size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        return WrittenEpisode(number, int(wanted.arrays["episode_length"]), size, row)


@dataclass(frozen=True)
class PendingEpisodes:
    """Missing episodes of a conversion; ``continued``: whether some episodes exist already."""

    settings: ConversionSettings
    writer: EpisodeWriter
    tasks: list[Task]
    continued: bool
    fix: str


def write_episodes(
    job: PendingEpisodes, output: OutputFolder, on_episode: Callable[[WrittenEpisode], None] | None
) -> tuple[list[WrittenEpisode], IncompleteDatasetError | None]:
    """Write episodes; return them by number, and an error that lists the episodes that can't be written.

    A failure does not stop the other episodes unless it concerns all: a full disk, a missing extra, or failures of the
    first three episodes.
    """
    settings = job.settings
    renders, processes = settings.is_trajectory, min(settings.jobs, len(job.tasks))
    apart = settings.limits is not None and settings.needs_device  # survives a crash of the renderer
    here = processes <= 1 and not apart
    threads = _one_torch_thread() if renders and here else nullcontext()
    open_worker = partial(_EpisodeWorker, job, one_rasterizer_thread=processes > 1, shared=here)
    pool: WorkerPool[Task, WrittenEpisode | _Failure] = WorkerPool(
        open_worker, 0 if here else processes, on_crash=_crash_failure, limits=settings.limits or NO_LIMITS
    )
    written: list[WrittenEpisode] = []
    failures: list[_Failure] = []
    with threads, pool, closing(pool.map(job.tasks, ordered=False)) as results:
        for result in results:
            if isinstance(result, WrittenEpisode):
                output.check_exists()
                written.append(result)
                if on_episode:
                    on_episode(result)
                continue
            failures.append(result)
            if written or job.continued:
                _log.warning("%s could not be written: %s", result.episode, result.reason)
            elif len(failures) == _MAX_FIRST_FAILURES:
                break
    if failures and not (written or job.continued):
        raise failures[0].sent.make_error()
    written.sort(key=lambda episode: episode.number)
    return written, _incomplete(failures, job) if failures else None


@dataclass(frozen=True)
class _Failure:
    """An episode that could not be written."""

    episode: str
    sent: RemoteError

    @property
    def reason(self) -> str:
        return format_error(self.sent.error).rstrip(".")


def _crash_failure(task: Task, why: str) -> _Failure:
    episode = episode_folder(task[0])
    return _Failure(
        episode,
        RemoteError.from_error(DatasetError(f"its worker process crashed twice: {why}", where=episode), "a worker"),
    )


def _incomplete(failures: list[_Failure], job: PendingEpisodes) -> IncompleteDatasetError:
    reasons = {one.episode: one.reason for one in sorted(failures, key=lambda one: one.episode)}
    listed = [why if why.startswith(f"{one}: ") else f"{one}: {why}" for one, why in reasons.items()]
    more = f"; and {len(listed) - _MAX_LISTED} more" if len(listed) > _MAX_LISTED else ""
    what = f"{format_count(len(listed), 'episode')} could not be written"
    error = IncompleteDatasetError(
        what, where=job.settings.out, found="; ".join(listed[:_MAX_LISTED]) + more, fix=job.fix
    )
    error.reasons, error.__cause__ = reasons, failures[0].sent.make_error()
    return error


class _EpisodeWorker:
    """Worker that writes episodes; the source stays open, and is opened again after a failure."""

    def __init__(self, job: PendingEpisodes, *, one_rasterizer_thread: bool, shared: bool) -> None:
        if job.settings.is_trajectory and not shared:
            if one_rasterizer_thread:  # software renderers on all cores slow each other down
                os.environ.setdefault("LP_NUM_THREADS", "1")
            use_one_torch_thread()
        self._job = job
        self._input: ConversionInput | None = open_input(job.settings)

    def run(self, task: Task) -> WrittenEpisode | _Failure:
        number, source = task
        try:
            self._input = self._input or open_input(self._job.settings)
            return self._job.writer.write(number, self._input, source)
        except Exception as error:
            if _concerns_all(error):
                raise
            self.close()
            return _Failure(episode_folder(number), RemoteError.from_error(error, "a worker"))

    def close(self) -> None:
        conversion_input, self._input = self._input, None
        if conversion_input is not None:
            conversion_input.close()


def _concerns_all(error: Exception) -> bool:
    """Return whether an error concerns all episodes: an error of the system or the installation."""
    return isinstance(error, MissingExtraError) or (
        isinstance(error, OSError) and error.errno in errno.errorcode
    )  # FFmpeg uses other numbers


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Use one torch thread: next to a renderer, spinning threads of torch double the CPU time."""
    import torch

    before = torch.get_num_threads()
    use_one_torch_thread()
    try:
        yield
    finally:
        torch.set_num_threads(before)
