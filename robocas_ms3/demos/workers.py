"""Generate the episodes of many seeds, in this process or in worker processes."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path

from robocas_ms3.core.workers import Limits, Worker, WorkerPool, use_one_torch_thread
from robocas_ms3.demos.ledger import EpisodeResult, Failure
from robocas_ms3.demos.settings import GenerateSettings
from robocas_ms3.demos.takeover import Takeover


def shard_name(seed: int) -> str:
    """Return the name of an episode's file before merging."""
    return f"seed_{seed:09d}"


def generate_seeds(
    settings: GenerateSettings,
    seeds: Iterator[int],
    folder: Path,
    players: Callable[[], Worker[int, Takeover]] | None = None,
) -> Generator[EpisodeResult, None, None]:
    """Yield the results of endless seeds in their order.

    Args:
        settings: options of the run.
        seeds: of the episodes.
        folder: gets a file for each episode.
        players: makes the worker that runs a policy before the demonstration, in processes of its own: a process that
            renders or uses CUDA can't be forked.
    """
    limits = Limits(settings.episode_seconds, settings.memory_gb)
    one_thread = settings.jobs > 0  # the user's own process keeps its threads
    with ExitStack() as stack:
        tasks: Iterator[int | Takeover] = seeds
        if players is not None:
            make_player = partial(_make_player, players, one_thread)
            on_crash = partial(_crashed_takeover, settings.episode.after_policy)
            acting = WorkerPool(make_player, settings.jobs, limits=limits, on_crash=on_crash)
            tasks = stack.enter_context(closing(stack.enter_context(acting).map(seeds)))
        make_worker = partial(_EpisodeWorker, settings, folder)
        pool = WorkerPool(make_worker, settings.jobs, limits=limits, on_crash=_crashed_episode)
        yield from stack.enter_context(pool).map(tasks)


class _EpisodeWorker:
    """Keeps the environment from one seed to the next."""

    def __init__(self, settings: GenerateSettings, folder: Path) -> None:
        from robocas_ms3.demos.generator import EpisodeGenerator  # takes seconds, and only workers need it

        if settings.jobs:  # the user's own process keeps its threads
            use_one_torch_thread()
        self._generator, self._folder = EpisodeGenerator(settings.episode, fork=settings.fork), folder

    def run(self, task: int | Takeover) -> EpisodeResult:
        seed, takeover = (task, None) if isinstance(task, int) else (task.seed, task)
        return self._generator.generate(seed, self._folder, shard_name(seed), takeover)

    def close(self) -> None:
        self._generator.close()


def _make_player(players: Callable[[], Worker[int, Takeover]], one_thread: bool) -> Worker[int, Takeover]:
    if one_thread:
        use_one_torch_thread()
    return players()


def _crashed_takeover(policy: str, seed: int, reason: str) -> Takeover:
    return Takeover(seed, policy, 0, {}, 1.0, reason)


def _crashed_episode(task: int | Takeover, reason: str) -> EpisodeResult:
    seed = task if isinstance(task, int) else task.seed
    return EpisodeResult(seed, success=False, attempts=1, failures=[Failure(seed, 0, "worker", reason, 0.0)])
