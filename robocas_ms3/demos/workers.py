"""Generates the episodes of many seeds, in this process or in several."""

from __future__ import annotations

import multiprocessing
from collections.abc import Generator, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from robocas_ms3.demos.episode import EpisodeGenerator, EpisodeResult, EpisodeSettings
from robocas_ms3.demos.ledger import Failure
from robocas_ms3.demos.parent import leave_with_parent

_worker: EpisodeGenerator | Exception | None = None


def shard_name(seed: int) -> str:
    """Name of an episode's file before merging."""
    return f"seed_{seed:09d}"


def generate_seeds(
    settings: EpisodeSettings, seeds: Iterator[int], folder: Path, jobs: int, *, fork: bool = True
) -> Generator[EpisodeResult, None, None]:
    """Results in the order of the seeds, which never end."""
    if jobs <= 1:
        generator = EpisodeGenerator(settings, fork=fork)
        try:
            for seed in seeds:
                yield generator.generate(seed, folder, shard_name(seed))
        finally:
            generator.close()
        return
    context = multiprocessing.get_context("spawn")  # what was loaded so far, a renderer perhaps, may not survive a fork
    waiting: list[int] = []  # seeds whose results are still to come
    suspects = (
        0  # how many of them were under way when a worker died: they run one by one, which shows whose fault it is
    )
    while True:
        # A crash of a worker (mplib's C++) breaks the pool: make a new one and run what was under way again.
        with ProcessPoolExecutor(
            jobs, mp_context=context, initializer=_start_worker, initargs=(settings, fork)
        ) as pool:
            under_way: dict[int, Future[EpisodeResult]] = {}
            try:
                while True:
                    while len(waiting) < 2 * jobs:
                        waiting.append(next(seeds))
                    for seed in waiting[:1] if suspects else waiting:
                        if seed not in under_way:
                            under_way[seed] = pool.submit(_generate, seed, folder)
                    result = under_way[waiting[0]].result()
                    waiting.pop(0)
                    suspects = max(0, suspects - 1)
                    yield result
            except BrokenProcessPool:
                if suspects:
                    suspects -= 1
                    failure = Failure(waiting[0], 0, "worker", "crashed", 0.0)
                    yield EpisodeResult(waiting.pop(0), success=False, attempts=1, failures=[failure])
                else:
                    suspects = len(waiting)
            except GeneratorExit:
                pool.shutdown(wait=True, cancel_futures=True)
                raise


def _start_worker(settings: EpisodeSettings, fork: bool) -> None:
    global _worker  # noqa: PLW0603  (one generator a process)
    leave_with_parent()
    try:
        _worker = EpisodeGenerator(settings, fork=fork)
    except Exception as error:  # noqa: BLE001  (raised by the first task: an initializer's own error breaks the pool)
        _worker = error


def _generate(seed: int, folder: Path) -> EpisodeResult:
    if isinstance(_worker, Exception):
        raise _worker
    assert _worker is not None
    return _worker.generate(seed, folder, shard_name(seed))
