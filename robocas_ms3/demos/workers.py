"""Generates the episodes of many seeds, in this process or in several."""

from __future__ import annotations

import multiprocessing
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocas_ms3.demos.episode import EpisodeResult, EpisodeSettings
from robocas_ms3.demos.ledger import Failure
from robocas_ms3.processes import NO_LIMITS, Limits, Pool, use_one_torch_thread

if TYPE_CHECKING:
    from robocas_ms3.demos.generator import EpisodeGenerator


def shard_name(seed: int) -> str:
    """Name of an episode's file before merging."""
    return f"seed_{seed:09d}"


def generate_seeds(
    settings: EpisodeSettings,
    seeds: Iterator[int],
    folder: Path,
    jobs: int,
    *,
    fork: bool = True,
    limits: Limits | None = None,
) -> Generator[EpisodeResult, None, None]:
    """Results in the order of the seeds, which never end; without limits one job is this process."""
    opened, here = partial(_open, settings, folder, fork), jobs <= 1 and limits is None
    with Pool(opened, jobs, died=_died, here=here, limits=limits or NO_LIMITS) as pool:
        yield from pool.do(seeds, in_order=True)


@dataclass(frozen=True)
class _Generates:
    """Keeps the environment from one seed to the next."""

    generator: EpisodeGenerator
    folder: Path

    def do(self, seed: int) -> EpisodeResult:
        return self.generator.generate(seed, self.folder, shard_name(seed))

    def close(self) -> None:
        self.generator.close()


def _open(settings: EpisodeSettings, folder: Path, fork: bool) -> _Generates:
    from robocas_ms3.demos.generator import EpisodeGenerator  # seconds, which a process that only waits can save

    if multiprocessing.parent_process():  # one of ours; the user's own keeps its threads
        use_one_torch_thread()
    return _Generates(EpisodeGenerator(settings, fork=fork), folder)


def _died(seed: int, why: str) -> EpisodeResult:
    """What a seed comes to that takes its process down, as mplib's C++ can."""
    return EpisodeResult(seed, success=False, attempts=1, failures=[Failure(seed, 0, "worker", why, 0.0)])
