"""Generates the episodes of many seeds, in this process or in several."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from robocas_ms3.core.workers import NO_LIMITS, Limits, Worker, WorkerPool, use_one_torch_thread
from robocas_ms3.demos.episode import EpisodeResult, EpisodeSettings
from robocas_ms3.demos.ledger import Failure
from robocas_ms3.demos.takeover import Takeover

if TYPE_CHECKING:
    from robocas_ms3.demos.generator import EpisodeGenerator


Task = TypeVar("Task")
Result = TypeVar("Result")


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
    num_workers = 0 if jobs <= 1 and limits is None else jobs

    def pool(
        make_worker: Callable[[], Worker[Task, Result]], on_crash: Callable[[Task, str], Result]
    ) -> WorkerPool[Task, Result]:
        in_process = partial(_make_in_process, make_worker) if num_workers else make_worker
        return WorkerPool(in_process, num_workers, limits=limits or NO_LIMITS, on_crash=on_crash)

    with ExitStack() as stack:
        tasks: Iterator[int | Takeover] = seeds
        if players is not None:
            acting = stack.enter_context(pool(players, partial(_none_left, settings.after_policy)))
            tasks = stack.enter_context(closing(acting.map(seeds)))
        generating = stack.enter_context(pool(partial(_open, settings, folder, fork), _crashed))
        yield from generating.map(tasks)


@dataclass(frozen=True)
class _Generates:
    """Keeps the environment from one seed to the next."""

    generator: EpisodeGenerator
    folder: Path

    def run(self, task: int | Takeover) -> EpisodeResult:
        seed, takeover = (task, None) if isinstance(task, int) else (task.seed, task)
        return self.generator.generate(seed, self.folder, shard_name(seed), takeover)

    def close(self) -> None:
        self.generator.close()


def _open(settings: EpisodeSettings, folder: Path, fork: bool) -> _Generates:
    from robocas_ms3.demos.generator import EpisodeGenerator  # seconds, which a process that only waits can save

    return _Generates(EpisodeGenerator(settings, fork=fork), folder)


def _make_in_process(make_worker: Callable[[], Worker[Task, Result]]) -> Worker[Task, Result]:
    use_one_torch_thread()
    return make_worker()


def _none_left(policy: str, seed: int, why: str) -> Takeover:
    """What a policy leaves that takes its process down."""
    return Takeover(seed, policy, 0, {}, 1.0, why)


def _crashed(task: int | Takeover, why: str) -> EpisodeResult:
    """Return the result of a seed whose worker process died."""
    seed = task if isinstance(task, int) else task.seed
    return EpisodeResult(seed, success=False, attempts=1, failures=[Failure(seed, 0, "worker", why, 0.0)])
