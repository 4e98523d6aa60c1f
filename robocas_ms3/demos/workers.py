"""Generate the episodes of many seeds, in this process or in worker processes."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path

from robocas_ms3.core.workers import NO_LIMITS, Limits, Worker, WorkerPool, use_one_torch_thread
from robocas_ms3.demos.episode import EpisodeResult, EpisodeSettings
from robocas_ms3.demos.ledger import Failure
from robocas_ms3.demos.takeover import Takeover


def shard_name(seed: int) -> str:
    """Return the name of an episode's file before merging."""
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
    """Yield the results in the order of the seeds, which never end.

    Args:
        settings: of the demonstrations.
        seeds: of the episodes.
        folder: gets a file for each episode.
        jobs: number of worker processes; 1 without ``limits``: this process.
        fork: whether to try candidates in forks.
        limits: of each seed.
        players: makes the worker that has a policy act before the demonstration, in processes of its own: a process
            that renders or uses CUDA can't be forked.
    """
    num_workers = 0 if jobs <= 1 and limits is None else jobs
    in_process = num_workers > 0
    with ExitStack() as stack:
        tasks: Iterator[int | Takeover] = seeds
        if players is not None:
            make_player = partial(_make_player, players, in_process)
            on_crash = partial(_crashed_takeover, settings.after_policy)
            acting = WorkerPool(make_player, num_workers, limits=limits or NO_LIMITS, on_crash=on_crash)
            tasks = stack.enter_context(closing(stack.enter_context(acting).map(seeds)))
        make_worker = partial(_EpisodeWorker, settings, folder, fork, in_process)
        pool = WorkerPool(make_worker, num_workers, limits=limits or NO_LIMITS, on_crash=_crashed_episode)
        yield from stack.enter_context(pool).map(tasks)


class _EpisodeWorker:
    """Keeps the environment from one seed to the next."""

    def __init__(self, settings: EpisodeSettings, folder: Path, fork: bool, in_process: bool) -> None:
        from robocas_ms3.demos.generator import EpisodeGenerator  # takes seconds, and only workers need it

        if in_process:  # the user's own process keeps its threads
            use_one_torch_thread()
        self._generator, self._folder = EpisodeGenerator(settings, fork=fork), folder

    def run(self, task: int | Takeover) -> EpisodeResult:
        seed, takeover = (task, None) if isinstance(task, int) else (task.seed, task)
        return self._generator.generate(seed, self._folder, shard_name(seed), takeover)

    def close(self) -> None:
        self._generator.close()


def _make_player(players: Callable[[], Worker[int, Takeover]], in_process: bool) -> Worker[int, Takeover]:
    if in_process:
        use_one_torch_thread()
    return players()


def _crashed_takeover(policy: str, seed: int, reason: str) -> Takeover:
    """Return the state after a policy whose worker process died: none."""
    return Takeover(seed, policy, 0, {}, 1.0, reason)


def _crashed_episode(task: int | Takeover, reason: str) -> EpisodeResult:
    """Return the result of a seed whose worker process died."""
    seed = task if isinstance(task, int) else task.seed
    return EpisodeResult(seed, success=False, attempts=1, failures=[Failure(seed, 0, "worker", reason, 0.0)])
