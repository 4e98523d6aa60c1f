"""Generates the episodes of many seeds, in this process or in several."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robocas_ms3.core.processes import NO_LIMITS, Limits, Pool, Worker, use_one_torch_thread
from robocas_ms3.demos.episode import EpisodeResult, EpisodeSettings
from robocas_ms3.demos.ledger import Failure
from robocas_ms3.demos.takeover import Takeover

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
    players: Callable[[], Worker[int, Takeover]] | None = None,
) -> Generator[EpisodeResult, None, None]:
    """Results in the order of the seeds, which never end; without limits one job is this process.

    Where ``players`` act first they do so in as many processes of their own, ahead of the generators: what renders, or
    uses CUDA, can't go back by forking.
    """
    opened, here = partial(_open, settings, folder, fork), jobs <= 1 and limits is None
    bounds = limits or NO_LIMITS
    with ExitStack() as stack:
        tasks: Iterator[int | Takeover] = seeds
        if players is not None:
            acting = stack.enter_context(
                Pool(players, jobs, died=partial(_none_left, settings.after_policy), here=here, limits=bounds)
            )
            tasks = stack.enter_context(closing(acting.do(seeds, in_order=True)))
        pool = stack.enter_context(Pool(opened, jobs, died=_died, here=here, limits=bounds))
        yield from pool.do(tasks, in_order=True)


@dataclass(frozen=True)
class _Generates:
    """Keeps the environment from one seed to the next."""

    generator: EpisodeGenerator
    folder: Path

    def do(self, task: int | Takeover) -> EpisodeResult:
        seed, takeover = (task, None) if isinstance(task, int) else (task.seed, task)
        return self.generator.generate(seed, self.folder, shard_name(seed), takeover)

    def close(self) -> None:
        self.generator.close()


def _open(settings: EpisodeSettings, folder: Path, fork: bool) -> _Generates:
    from robocas_ms3.demos.generator import EpisodeGenerator  # seconds, which a process that only waits can save

    if multiprocessing.parent_process():  # one of ours; the user's own keeps its threads
        use_one_torch_thread()
    return _Generates(EpisodeGenerator(settings, fork=fork), folder)


def _none_left(policy: str, seed: int, why: str) -> Takeover:
    """What a policy leaves that takes its process down."""
    return Takeover(seed, policy, 0, {}, 1.0, why)


def _died(task: int | Takeover, why: str) -> EpisodeResult:
    """Return the result of a seed whose worker process died."""
    seed = task if isinstance(task, int) else task.seed
    return EpisodeResult(seed, success=False, attempts=1, failures=[Failure(seed, 0, "worker", why, 0.0)])
