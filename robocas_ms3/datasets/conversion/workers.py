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

EpisodeNumbers = tuple[int, int]
"""Number of an episode in the dataset, and in the source."""


@dataclass(frozen=True)
class InputEpisode:
    """Episode to write: its number in the dataset, its source episode, and its checked arrays."""

    number: int
    source_episode: SourceEpisode
    arrays: dict[str, NDArray]
    conversion_input: ConversionInput


class EpisodeWriter(ABC):
    """Writes the episodes of one dataset format; must be picklable."""

    @abstractmethod
    def folder(self, number: int) -> Path:
        """Return the path of the folder of an episode, which `write` creates atomically."""

    @abstractmethod
    def write_files(
        self, folder: Path, episode: InputEpisode, frames: Generator[StepImages, None, None]
    ) -> NDArray[np.uint8] | None:
        """Write the files of an episode into a folder; return its contact sheet row (H, W, 3) RGB, or None."""

    def write(self, number: int, conversion_input: ConversionInput, source_number: int) -> WrittenEpisode:
        """Write episode ``source_number`` of the input as episode ``number`` of the dataset."""
        with atomic_folder(self.folder(number), sync=True) as folder:
            source_episode = conversion_input.source.episode(source_number)
            episode = InputEpisode(number, source_episode, require_complete_arrays(source_episode), conversion_input)
            with closing(conversion_input.frames(source_episode)) as frames:
                row = self.write_files(folder, episode, frames)
            size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        return WrittenEpisode(number, int(episode.arrays["episode_length"]), size, row)


@dataclass(frozen=True)
class PendingEpisodes:
    """Episodes that a conversion has to write.

    Attributes:
        settings: settings of the conversion.
        writer: writer of the episodes.
        tasks: number of each episode in the dataset and in the source.
        has_existing: whether the dataset has episodes already.
        fix: advice in the error about episodes that can't be written.
    """

    settings: ConversionSettings
    writer: EpisodeWriter
    tasks: list[EpisodeNumbers]
    has_existing: bool
    fix: str


def write_episodes(
    pending: PendingEpisodes, output: OutputFolder, on_episode: Callable[[WrittenEpisode], None] | None
) -> tuple[list[WrittenEpisode], IncompleteDatasetError | None]:
    """Write the pending episodes; return the written episodes sorted by number, and an error or None.

    The error lists the episodes that can't be written. One failed episode does not stop the others. A full disk, a
    missing extra, or failures of the first three episodes of a new dataset stop the conversion with that error.
    """
    settings = pending.settings
    renders, processes = settings.is_trajectory, min(settings.jobs, len(pending.tasks))
    apart = settings.limits is not None and settings.needs_renderer  # survives a crash of the renderer
    here = processes <= 1 and not apart
    threads = _limit_torch_threads() if renders and here else nullcontext()
    open_worker = partial(_EpisodeWorker, pending, one_rasterizer_thread=processes > 1, in_process=here)
    pool: WorkerPool[EpisodeNumbers, WrittenEpisode | _Failure] = WorkerPool(
        open_worker, 0 if here else processes, on_crash=_make_crash_failure, limits=settings.limits or NO_LIMITS
    )
    written: list[WrittenEpisode] = []
    failures: list[_Failure] = []
    with threads, pool, closing(pool.map(pending.tasks, ordered=False)) as results:
        for result in results:
            if isinstance(result, WrittenEpisode):
                output.check_exists()
                written.append(result)
                if on_episode:
                    on_episode(result)
                continue
            failures.append(result)
            if written or pending.has_existing:
                _log.warning("%s could not be written: %s", result.episode, result.reason)
            elif len(failures) == _MAX_FIRST_FAILURES:
                break
    if failures and not (written or pending.has_existing):
        raise failures[0].error.make_error()
    written.sort(key=lambda episode: episode.number)
    return written, _make_incomplete_error(failures, pending) if failures else None


@dataclass(frozen=True)
class _Failure:
    """Episode that could not be written, and the error."""

    episode: str
    error: RemoteError

    @property
    def reason(self) -> str:
        return format_error(self.error.error).rstrip(".")


def _make_crash_failure(task: EpisodeNumbers, reason: str) -> _Failure:
    episode = episode_folder(task[0])
    return _Failure(
        episode,
        RemoteError.from_error(DatasetError(f"its worker process crashed twice: {reason}", where=episode), "a worker"),
    )


def _make_incomplete_error(failures: list[_Failure], pending: PendingEpisodes) -> IncompleteDatasetError:
    reasons = {one.episode: one.reason for one in sorted(failures, key=lambda one: one.episode)}
    listed = [why if why.startswith(f"{one}: ") else f"{one}: {why}" for one, why in reasons.items()]
    more = f"; and {len(listed) - _MAX_LISTED} more" if len(listed) > _MAX_LISTED else ""
    what = f"{format_count(len(listed), 'episode')} could not be written"
    error = IncompleteDatasetError(
        what, where=pending.settings.out, found="; ".join(listed[:_MAX_LISTED]) + more, fix=pending.fix
    )
    error.reasons, error.__cause__ = reasons, failures[0].error.make_error()
    return error


class _EpisodeWorker:
    """Writes episodes; keeps the input open between episodes and opens it again after a failure."""

    def __init__(self, pending: PendingEpisodes, *, one_rasterizer_thread: bool, in_process: bool) -> None:
        if pending.settings.is_trajectory and not in_process:
            if one_rasterizer_thread:  # software renderers on all cores slow each other down
                os.environ.setdefault("LP_NUM_THREADS", "1")
            use_one_torch_thread()
        self._pending = pending
        self._input: ConversionInput | None = open_input(pending.settings)

    def run(self, task: EpisodeNumbers) -> WrittenEpisode | _Failure:
        number, source = task
        try:
            self._input = self._input or open_input(self._pending.settings)
            return self._pending.writer.write(number, self._input, source)
        except Exception as error:
            if _affects_all_episodes(error):
                raise
            self.close()
            return _Failure(episode_folder(number), RemoteError.from_error(error, "a worker"))

    def close(self) -> None:
        conversion_input, self._input = self._input, None
        if conversion_input is not None:
            conversion_input.close()


def _affects_all_episodes(error: Exception) -> bool:
    """Return whether all episodes would fail in the same way: an error of the system, or a missing extra."""
    return isinstance(error, MissingExtraError) or (
        isinstance(error, OSError) and error.errno in errno.errorcode
    )  # FFmpeg uses other numbers


@contextmanager
def _limit_torch_threads() -> Iterator[None]:
    """Limit PyTorch to one thread: next to a renderer, idle threads double the CPU time."""
    import torch

    before = torch.get_num_threads()
    use_one_torch_thread()
    try:
        yield
    finally:
        torch.set_num_threads(before)
