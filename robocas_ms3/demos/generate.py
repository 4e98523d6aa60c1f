"""Generate demonstrations over seeds and worker processes into one ManiSkill trajectory file."""

from __future__ import annotations

import multiprocessing
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from robocas_ms3.demos.checks import check_arguments, check_same_run
from robocas_ms3.demos.episode import EpisodeGenerator, EpisodeResult, EpisodeSettings
from robocas_ms3.demos.ledger import Failure, Ledger, count_by_stage
from robocas_ms3.demos.record import merge, open_trajectory, read_json
from robocas_ms3.errors import RobocasError
from robocas_ms3.files import claim_output, locked_folder, make_folder, write_json

_BEGINNINGS = {"run.json", "failures.jsonl", "episodes"}  # of a run that has not finished a seed yet
_worker: EpisodeGenerator | Exception | None = None


@dataclass(frozen=True)
class Summary:
    """What a run did.

    Attributes:
        trajectory: the HDF5 file.
        episodes: episodes in it.
        seeds: seeds tried for them.
        mean_seconds: per seed tried: reset, planning, simulation.
        mean_steps: control steps an episode.
        failures: ``{"stage: reason": count}`` of all attempts.
        gave_up: seeds without an episode.
    """

    trajectory: Path
    episodes: int
    seeds: int
    mean_seconds: dict[str, float]
    mean_steps: float
    failures: dict[str, int]
    gave_up: list[int]

    @property
    def success_rate(self) -> float:
        """Episodes per seed tried."""
        return self.episodes / self.seeds if self.seeds else 0.0


def generate(
    settings: EpisodeSettings,
    out: Path,
    *,
    episodes: int,
    first_seed: int = 0,
    jobs: int = 1,
    resume: bool = False,
    overwrite: bool = False,
    on_start: Callable[[], None] = lambda: None,
    on_result: Callable[[EpisodeResult], None] = lambda result: None,
) -> Summary:
    """Generate episodes of consecutive seeds until there are enough.

    ``out`` gets ``trajectory.h5`` and ``.json``, ``failures.jsonl``, ``run.json`` (how it was made) and
    ``summary.json``. Each finished episode is a file of its own under ``out/episodes`` until the end, so that an
    interrupted run goes on with ``resume``. Seeds are consecutive and results are taken in their order, so neither
    ``jobs`` nor an interruption changes the outcome.

    Args:
        settings: the same for all episodes.
        out: output folder.
        episodes: successful episodes wanted.
        first_seed: seeds are counted from here.
        jobs: worker processes.
        resume: go on with what is in ``out``.
        overwrite: replace what is in ``out``.
        on_start: called once arguments, configuration, pack and output turned out right.
        on_result: called for each seed, in order.

    Raises:
        OutputExistsError: ``out`` has content and neither flag is set.
        RobocasError: an argument is wrong, which leaves no trace; ``out`` was made with other settings, or another
            process writes there; far too many seeds fail.
    """
    check_arguments(settings, episodes=episodes, first_seed=first_seed, jobs=jobs)
    if overwrite and out.is_dir() and any(out.iterdir()) and not (out / "run.json").is_file():
        raise RobocasError("this folder was not made by `robocas generate`", where=out, fix="It stays; choose another.")
    with locked_folder(out):
        if _only_begun(out):
            shutil.rmtree(out)
        claim_output(out, overwrite=overwrite, resume=resume)
        run = {"settings": asdict(settings), "first_seed": first_seed}
        check_same_run(out / "run.json", run)
        make_folder(out)
        write_json(out / "run.json", run)
        on_start()
        return _generate_in(out, settings, episodes, first_seed, jobs, on_result)


def _only_begun(out: Path) -> bool:
    """Whether a run was begun here, and ended before it was through with a seed."""
    if not (out / "run.json").is_file() or {path.name for path in out.iterdir()} - _BEGINNINGS:
        return False
    return not _finished(out, out / "episodes", Ledger(out / "failures.jsonl"))


def _generate_in(
    out: Path,
    settings: EpisodeSettings,
    episodes: int,
    first_seed: int,
    jobs: int,
    on_result: Callable[[EpisodeResult], None],
) -> Summary:
    shards, ledger = make_folder(out / "episodes"), Ledger(out / "failures.jsonl")
    results = _finished(out, shards, ledger)
    ledger.keep_only({result.seed for result in results})
    seeds = _seeds(first_seed, {result.seed for result in results})
    results = [r for r in results if r.seed >= first_seed]
    try:
        if sum(r.success for r in results) < episodes:
            for result in _run(settings, seeds, shards, jobs):
                lines = list(result.failures)
                if not result.success:
                    lines.append(Failure(result.seed, -1, "episode", "gave_up", 0.0))
                ledger.append(lines)
                results.append(result)
                on_result(result)
                good = sum(r.success for r in results)
                if good >= episodes:
                    break
                if len(results) - good > max(20, 3 * good):
                    raise RobocasError(
                        "far too many seeds fail",
                        where=out,
                        found=f"{len(results) - good} of {len(results)}",
                        fix=f"See {ledger.path.name}; a smaller objects.count may help.",
                    )
    except RobocasError:
        if not results:
            shutil.rmtree(out)  # it never began
        raise
    finally:
        results.sort(key=lambda r: r.seed)
    return _finish(out, shards, ledger, results)


def _seeds(first: int, done: set[int]) -> Iterator[int]:
    seed = first
    while True:
        if seed not in done:
            yield seed
        seed += 1


def shard_name(seed: int) -> str:
    """Name of an episode's file before merging."""
    return f"seed_{seed:09d}"


def _run(settings: EpisodeSettings, seeds: Iterator[int], folder: Path, jobs: int) -> Iterator[EpisodeResult]:
    """Results in the order of the seeds."""
    if jobs <= 1:
        generator = EpisodeGenerator(settings)
        try:
            for seed in seeds:
                yield generator.generate(seed, folder, shard_name(seed))
        finally:
            generator.close()
        return
    context = multiprocessing.get_context("spawn")  # neither PhysX nor torch survives a fork
    pending: list[tuple[int, Future[EpisodeResult] | None]] = []
    crashes: dict[int, int] = {}
    while True:
        # A crash of a worker (mplib's C++) breaks the pool: make a new one and run what was under way again.
        with ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker, initargs=(settings,)) as pool:
            try:
                pending = [(seed, pool.submit(_generate, seed, folder)) for seed, _ in pending]
                while True:
                    while len(pending) < 2 * jobs:
                        seed = next(seeds)
                        pending.append((seed, pool.submit(_generate, seed, folder)))
                    seed, future = pending[0]
                    assert future is not None
                    result = future.result()
                    pending.pop(0)
                    yield result
            except BrokenProcessPool:
                seed = pending[0][0]
                crashes[seed] = crashes.get(seed, 0) + 1
                if crashes[seed] >= 2:
                    pending.pop(0)
                    failure = Failure(seed, 0, "worker", "crashed", 0.0)
                    yield EpisodeResult(seed, success=False, attempts=1, failures=[failure])
            except GeneratorExit:
                pool.shutdown(wait=True, cancel_futures=True)
                raise


def _start_worker(settings: EpisodeSettings) -> None:
    global _worker  # noqa: PLW0603  (one generator a process)
    try:
        _worker = EpisodeGenerator(settings)
    except Exception as error:  # noqa: BLE001  (raised by the first task: an initializer's own error breaks the pool)
        _worker = error


def _generate(seed: int, folder: Path) -> EpisodeResult:
    if isinstance(_worker, Exception):
        raise _worker
    assert _worker is not None
    return _worker.generate(seed, folder, shard_name(seed))


def _finished(out: Path, shards: Path, ledger: Ledger) -> list[EpisodeResult]:
    """Seeds that an earlier run dealt with: in the merged file, in files of their own, or given up."""
    results = {}
    sources = [out / "trajectory.h5"] if (out / "trajectory.h5").is_file() else []
    for path in [*sources, *sorted(shards.glob("seed_*.h5"))]:
        try:
            for episode in read_json(path)["episodes"]:
                seed = int(episode["episode_seed"])
                # the block is written last: without it the episode was cut short
                if "robocas" in episode:
                    result = EpisodeResult(seed, True, int(episode["elapsed_steps"]), episode["robocas"]["attempts"])
                    for part, value in episode["robocas"]["seconds"].items():
                        setattr(result.seconds, part, value)
                    results[seed] = result
            open_trajectory(path).close()
        except RobocasError:
            if path in sources:
                raise
            results.pop(int(path.stem.removeprefix("seed_")), None)
            path.unlink()
    for failure in ledger.read():
        if failure.gave_up:
            results[failure.seed] = EpisodeResult(failure.seed, success=False)
    return list(results.values())


def _finish(out: Path, shards: Path, ledger: Ledger, results: list[EpisodeResult]) -> Summary:
    good = [r for r in results if r.success]
    trajectory = out / "trajectory.h5"
    wanted = [shards / f"{shard_name(r.seed)}.h5" for r in good]
    new = [path for path in wanted if path.is_file()]
    if new:
        merge(([trajectory] if trajectory.is_file() else []) + new, trajectory)
    shutil.rmtree(shards)
    parts = ("reset", "planning", "simulation")
    seconds = {p: round(float(np.mean([getattr(r.seconds, p) for r in results] or [0])), 3) for p in parts}
    summary = Summary(
        trajectory,
        len(good),
        len(results),
        seconds,
        round(float(np.mean([r.steps for r in good] or [0])), 1),
        count_by_stage(ledger.read()),
        [r.seed for r in results if not r.success],
    )
    write_json(
        out / "summary.json", {**asdict(summary), "trajectory": trajectory.name, "success_rate": summary.success_rate}
    )
    return summary
