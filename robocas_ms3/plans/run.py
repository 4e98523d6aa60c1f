"""Run a plan: run work units by an executor until each part has its episodes, then join the episodes."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from threading import Event
from typing import Any

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.output_folder import OutputFolder
from robocas_ms3.core.signals import deferred_interrupts
from robocas_ms3.core.text import format_count
from robocas_ms3.plans.executors import Executor
from robocas_ms3.plans.folder import WorkUnit, read_plan
from robocas_ms3.plans.join import join
from robocas_ms3.plans.load import check_plan
from robocas_ms3.plans.progress import Progress, Shard
from robocas_ms3.plans.status import Status, status_of

_MAX_KILLED_JOBS = 3  # that end at the same seed of a work unit
_JOB_INTERVAL = 0.05  # s between two checks of the jobs
_FOLDER_INTERVAL = 1.0  # least time between two reads of the folder, s
_SEEDS_PER_SECOND = 10_000.0  # limit of the seeds read from the folder


def _ignore(value: object) -> None:
    pass


def run_plan(
    executor: Executor,
    *,
    overwrite: bool = False,
    on_status: Callable[[Status], None] = _ignore,
    on_stage: Callable[[str], None] = _ignore,
) -> dict[str, Any]:
    """Generate the dataset of a plan, or continue, and return the content of ``report.json``.

    The dataset depends only on the plan.

    Args:
        executor: runs the work units. Its folder gets ``plan.json``, ``units/``, and at the end ``demos/``,
            ``datasets/``, ``statistics/`` and ``report.json``.
        overwrite: replace the content of the folder.
        on_status: called with the status, at most once per second.
        on_stage: called with the name of each stage.

    Raises:
        OutputExistsError: the folder was started with another plan or other versions, or by another command.
        PlanError: too many seeds of a part fail, or jobs are killed again and again.
        RobocasError: another run writes into the folder, or an error that affects all seeds.
    """
    folder = executor.folder
    check_plan(folder.plan)
    with folder.open(overwrite=overwrite) as output:
        output.start(folder.record())
        with executor:
            progress = Progress(folder)
            _run_units(executor, progress, output, on_status)
            if damaged := progress.delete_damaged():
                on_stage(
                    f"recording {format_count(sum(map(len, damaged.values())), 'episode')} with damaged files again"
                )
                _run_units(executor, progress, output, on_status)
            if damaged := damaged and progress.delete_damaged():
                unit, seeds = min(damaged.items())
                found, fix = f"seed {seeds[0]}, written twice", "Check the disk; then run the command again."
                what, where = "files change their size after writing", folder.unit_folder(unit)
                raise PlanError(what, where=where, found=found, fix=fix)
        return join(folder, progress.chosen_episodes(), jobs=executor.jobs, on_stage=on_stage)


def run_shard(
    executor: Executor,
    shard: Shard,
    on_status: Callable[[Status], None] = _ignore,
) -> bool:
    """Run the missing work units of a shard; other shards may run in the same folder.

    Returns:
        Whether all work units of the plan are complete, so that `join_plan` can join them.

    Raises:
        RobocasError: as `run_plan`.
    """
    folder = executor.folder
    check_plan(folder.plan)
    with folder.open(shared=True) as output:
        output.start(folder.record())
        progress = Progress(folder)
        if next(progress.missing(shard), None):
            with executor:
                _run_units(executor, progress, output, on_status, shard)
    progress.read()
    return next(progress.missing(), None) is None


def join_plan(out: Path, *, jobs: int = 1, on_stage: Callable[[str], None] = _ignore) -> dict[str, Any]:
    """Join the episodes of a plan whose work units are complete; return the content of ``report.json``.

    Raises:
        PlanError: work units are missing, or files are damaged.
        OutputExistsError: this machine has other versions of the packages.
        RobocasError: another run writes into ``out``.
    """
    folder = read_plan(out)
    with folder.open():
        progress = Progress(folder)
        progress.delete_damaged()
        missing = [f"{folder.unit_folder(unit).relative_to(out)}" for unit in progress.missing()]
        if missing:
            what, fix = "cannot join: work units are missing", "Run the missing work units with robocas plan run."
            found = f"{format_count(len(missing), 'missing work unit')}, the first is {missing[0]}"
            raise PlanError(what, where=out, found=found, fix=fix)
        return join(folder, progress.chosen_episodes(), jobs=jobs, on_stage=on_stage)


def _run_units(
    executor: Executor,
    progress: Progress,
    output: OutputFolder,
    on_status: Callable[[Status], None],
    shard: Shard = (0, 1),
) -> None:
    """Run the work units that are needed; failed seeds make more units necessary."""
    running: dict[Any, Sequence[WorkUnit]] = {}
    killed: Counter[tuple[WorkUnit, int]] = Counter()  # (unit, number of its complete seeds) -> killed jobs
    shown = -math.inf
    while True:
        busy = {unit for units in running.values() for unit in units}
        free = executor.jobs - len(running)
        pending = (unit for unit in progress.missing(shard) if unit not in busy)
        units = list(islice(pending, free * executor.units_per_job))
        if units:
            size = math.ceil(len(units) / free)
            groups = [units[first : first + size] for first in range(0, len(units), size)]
            running |= zip(executor.submit(groups), groups, strict=False)
        if time.monotonic() > shown:
            output.check_exists()
            progress.read()
            progress.check_failures()
            status = status_of(progress)
            on_status(status)
            shown = time.monotonic() + max(
                _FOLDER_INTERVAL, sum(part.tried for part in status.parts) / _SEEDS_PER_SECOND
            )
        if next(progress.missing(shard), None) is None:
            on_status(status_of(progress))
            return
        for job in _wait_for_jobs(running, shown):
            job.result()
            for unit in running.pop(job):
                if progress.add(unit):
                    continue
                killed[position := (unit, len(progress.partial[unit]))] += 1
                if killed[position] >= _MAX_KILLED_JOBS:
                    fix = f"See {executor.describe_log(job)}; the jobs may need more memory or time."
                    where, found = executor.folder.unit_folder(unit), f"{killed[position]} in a row"
                    raise PlanError("the jobs of this work unit were killed", where=where, found=found, fix=fix)
                break  # the job was killed in this unit
        progress.check_failures()


def _wait_for_jobs(running: dict[Any, Sequence[WorkUnit]], until: float) -> list[Any]:
    """Wait until a job has ended, or the time is over; return the jobs that have ended."""
    while True:
        with deferred_interrupts():  # Ctrl-C inside `done` could leave the lock of a future locked
            ended = [job for job in running if job.done()]
        if ended or time.monotonic() > until:
            return ended
        Event().wait(_JOB_INTERVAL)
