"""Generate demonstrations over seeds and worker processes into one ManiSkill trajectory file."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, fields
from itertools import count
from pathlib import Path

import numpy as np

from robocas_ms3.core.errors import DatasetError, RobocasError
from robocas_ms3.core.files import flush_to_disk, make_folder, write_json
from robocas_ms3.core.outputs import FolderKind, OutputFolder
from robocas_ms3.core.workers import Limits, Worker
from robocas_ms3.demos.checks import WEIGHTS, check_arguments, upgrade_run
from robocas_ms3.demos.episode import EpisodeResult, EpisodeSettings
from robocas_ms3.demos.ledger import FAILURES_FILE, Failure, Ledger, count_by_stage, failed_attempts
from robocas_ms3.demos.recordings.entries import read_json, reason
from robocas_ms3.demos.recordings.merging import merge
from robocas_ms3.demos.recordings.stored import open_trajectory
from robocas_ms3.demos.recordings.versions import versions
from robocas_ms3.demos.takeover import Takeover
from robocas_ms3.demos.workers import generate_seeds, shard_name
from robocas_ms3.planning.seconds import Seconds

RUN = "run.json"
OUTPUT = FolderKind("robocas generate", (RUN,), "settings", upgrade=upgrade_run)


@dataclass(frozen=True)
class Summary:
    """What a run did.

    Attributes:
        trajectory: the HDF5 file.
        episodes: episodes in it.
        seeds: seeds tried for them.
        mean_seconds: CPU seconds per seed tried: reset, planning, simulation, trial.
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
    fork: bool = True,
    limits: Limits | None = None,
    overwrite: bool = False,
    on_start: Callable[[int], None] = lambda there: None,
    on_result: Callable[[EpisodeResult], None] = lambda result: None,
    players: Callable[[], Worker[int, Takeover]] | None = None,
    weights: str = "",
) -> Summary:
    """Generate episodes of consecutive seeds until there are enough.

    ``out`` gets ``trajectory.h5`` and ``.json``, ``failures.jsonl``, ``run.json`` (settings and versions) and
    ``summary.json``. Each finished episode is a file of its own under ``out/episodes`` until the end: calling again
    continues an interrupted run, or adds episodes to a finished one. Seeds are consecutive and results are taken in
    their order, so neither ``jobs`` nor an interruption changes the outcome.

    Args:
        settings: the same for all episodes.
        out: output folder.
        episodes: successful episodes wanted.
        first_seed: seeds are counted from here.
        jobs: worker processes.
        fork: undo what fails by forking where that is safe.
        limits: of each seed. With them one job is a process of its own too; a seed that goes beyond them, or takes its
            process down, is begun again once, and then given up. None: with one job this process does it.
        overwrite: start again, and replace the run in ``out``.
        on_start: called once arguments, configuration, pack and output turned out right, with how many of the episodes
            are there.
        on_result: called for each seed that was not dealt with before, in order.
        players: opens what has ``settings.after_policy`` act in the scene of a seed, in a process (is pickled).
        weights: hash of those that it acts with, if it has some: an output goes on with the same.

    Raises:
        OutputExistsError: ``out`` was written with other settings or versions, or by another command.
        RobocasError: an argument is wrong, which leaves no trace; another process writes there; far too many seeds
            fail.
    """
    check_arguments(settings, episodes=episodes, first_seed=first_seed, jobs=jobs, acts_first=players is not None)
    run = {"settings": asdict(settings), "first_seed": first_seed, "versions": versions()}
    if weights:
        run[WEIGHTS] = weights
    with OutputFolder(out, OUTPUT, run, overwrite=overwrite) as output:
        output.start(run)
        return _generate_in(output, settings, episodes, first_seed, jobs, fork, limits, on_start, on_result, players)


def _generate_in(
    output: OutputFolder,
    settings: EpisodeSettings,
    episodes: int,
    first_seed: int,
    jobs: int,
    fork: bool,
    limits: Limits | None,
    on_start: Callable[[int], None],
    on_result: Callable[[EpisodeResult], None],
    players: Callable[[], Worker[int, Takeover]] | None,
) -> Summary:
    out = output.path
    shards, ledger = make_folder(out / "episodes"), Ledger(out / FAILURES_FILE)
    earlier = _finished(out, shards, ledger)
    ledger.settle([line for seed in sorted(earlier) for line in _lines(earlier[seed])])
    on_start(min(episodes, sum(result.success for result in earlier.values())))
    missing = (seed for seed in count(first_seed) if seed not in earlier)
    results: list[EpisodeResult] = []
    good = 0
    try:
        made = generate_seeds(settings, missing, shards, jobs, fork=fork, limits=limits, players=players)
        with closing(made) as new:
            for seed in count(first_seed):
                if good >= episodes:
                    break
                if seed in earlier:
                    results.append(earlier[seed])
                    good += earlier[seed].success
                    continue
                result = next(new)
                output.check_exists()
                ledger.append(_lines(result))
                results.append(result)
                good += result.success
                on_result(result)
                if len(results) - good > max(20, 3 * good):
                    raise RobocasError(
                        "far too many seeds fail",
                        where=out,
                        found=f"{len(results) - good} of {len(results)}",
                        fix=f"See {ledger.path.name}; a smaller objects.count may help.",
                    )
    except BaseException:
        if not (results or earlier):
            shutil.rmtree(shards, ignore_errors=True)  # unfinished episodes
        raise
    return _finish(out, shards, ledger, results, earlier)


def _lines(result: EpisodeResult) -> list[Failure]:
    """What the ledger says of a seed."""
    given_up = [] if result.success else [Failure(result.seed, -1, "episode", "gave_up", 0.0)]
    return [*result.failures, *given_up]


def _finished(out: Path, shards: Path, ledger: Ledger) -> dict[int, EpisodeResult]:
    """Seeds that an earlier run dealt with: in the merged file, in files of their own, or given up."""
    noted = ledger.by_seed()
    results = {
        seed: EpisodeResult(seed, success=False, failures=lines[:-1])
        for seed, lines in noted.items()
        if [line.attempt for line in lines] == [*range(len(lines) - 1), -1]  # else some are lost: it is run again
    }
    for path in sorted(shards.glob("seed_*.h5")):
        try:
            open_trajectory(path).close()
            results |= _recorded(path, noted)
        except RobocasError:
            path.unlink()
    return results | _merged(out, noted)


def _recorded(path: Path, noted: Mapping[int, list[Failure]]) -> dict[int, EpisodeResult]:
    """Seed -> what came of it, of each episode in a file; ``noted`` are the ledger's lines by seed.

    Raises:
        DatasetError: its JSON says something else.
    """
    results = {}
    for episode in read_json(path)["episodes"]:
        try:
            # the block is written last: without it the episode was cut short
            if said := episode.get("robocas"):
                seed = int(episode["episode_seed"])
                result = EpisodeResult(seed, True, int(episode["elapsed_steps"]), int(said["attempts"]))
                before = noted.get(seed, [])
                known = said.get("failed_attempts")  # those of an earlier version don't say
                result.failures = before if known is None else failed_attempts(seed, known, before)
                for part, value in said["seconds"].items():
                    setattr(result.seconds, part, float(value))
                results[seed] = result
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            where, fix = path.with_suffix(".json"), "Choose another --out, or --overwrite."
            raise DatasetError(
                "this is not of `robocas generate`", where=where, found=reason(error), fix=fix
            ) from error
    return results


def _merged(out: Path, noted: Mapping[int, list[Failure]]) -> dict[int, EpisodeResult]:
    """What the merged file holds; parameters of `_recorded`."""
    path = out / "trajectory.h5"
    if not path.is_file():
        return {}
    data = read_json(path)
    with open_trajectory(path) as file:
        there = [episode for episode in data["episodes"] if f"traj_{episode['episode_id']}" in file]
    if len(there) < len(data["episodes"]):  # a merge was killed between its two files
        write_json(path.with_suffix(".json"), {**data, "episodes": there})
    return _recorded(path, noted)


def _finish(
    out: Path, shards: Path, ledger: Ledger, results: list[EpisodeResult], earlier: dict[int, EpisodeResult]
) -> Summary:
    trajectory, merged = out / "trajectory.h5", _merged(out, ledger.by_seed())
    beyond = range(results[-1].seed + 1, max(merged, default=-1) + 1)  # more are there than were asked for
    results = [*results, *(earlier[seed] for seed in beyond if seed in earlier)]
    good = [r for r in results if r.success]
    new = [shards / f"{shard_name(r.seed)}.h5" for r in good if r.seed not in merged]
    if new:
        merge(([trajectory] if merged else []) + new, trajectory)
        flush_to_disk(out)  # before the files go that it is made of
    shutil.rmtree(shards)
    ledger.settle([line for result in results for line in _lines(result)])
    parts = [part.name for part in fields(Seconds)]
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
