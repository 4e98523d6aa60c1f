"""Runs a plan: has work units done until every part has its episodes, then joins them."""

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

_TRIES = 3  # jobs that may end at the same seed of a unit
_POLL = 0.05  # s between two looks at the jobs
_LOOK = 1.0  # s between two looks at the folder, at least
_LOOKS = 10_000.0  # seeds per second that are looked at, at most


def _ignore(value: object) -> None:
    pass


def run_plan(
    executor: Executor,
    *,
    overwrite: bool = False,
    on_status: Callable[[Status], None] = _ignore,
    on_stage: Callable[[str], None] = _ignore,
) -> dict[str, Any]:
    """Make the dataset of a plan, or continue, and return the content of ``report.json``.

    The dataset depends on the plan alone.

    Args:
        executor: has the units done. Its output folder gets ``plan.json``, ``units/``, and in the end ``demos/``,
            ``datasets/``, ``statistics/``, ``report.json``.
        overwrite: replace the content of the folder.
        on_status: called with the status, at most once per second.
        on_stage: called with the name of each stage.

    Raises:
        OutputExistsError: the folder was started with another plan or other versions, or by another command.
        PlanError: almost all seeds of a part fail.
        RobocasError: another run writes into the folder; or an error that every seed would meet.
    """
    folder = executor.folder
    check_plan(folder.plan)
    with folder.open(overwrite=overwrite) as output:
        output.start(folder.record())
        with executor:
            progress = Progress(folder)
            _run_units(executor, progress, output, on_status)
            if damaged := progress.delete_damaged():
                on_stage(f"{format_count(sum(map(len, damaged.values())), 'episode')} again: damaged files")
                _run_units(executor, progress, output, on_status)
            if damaged := damaged and progress.delete_damaged():
                unit, seeds = min(damaged.items())
                found, fix = f"seed {seeds[0]}, made twice", "Check the disk; then run the command again."
                what, where = "files don't keep the sizes that they were written with", folder.unit_folder(unit)
                raise PlanError(what, where=where, found=found, fix=fix)
        return join(folder, progress.chosen(), jobs=executor.jobs, on_stage=on_stage)


def run_shard(
    executor: Executor,
    shard: Shard,
    on_status: Callable[[Status], None] = _ignore,
) -> bool:
    """Do the work units of a shard that are needed and not done, next to other shards in the same folder.

    Returns whether no unit of the plan is missing: `join_plan` can join it. Raises as `run_plan` does.
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
    """Join the episodes of a plan whose work units are done; return the content of ``report.json``.

    Raises:
        PlanError: units are missing, or files are damaged.
        OutputExistsError: this machine has other versions.
        RobocasError: another run writes into ``out``.
    """
    folder = read_plan(out)
    with folder.open():
        progress = Progress(folder)
        progress.delete_damaged()
        missing = [f"{folder.unit_folder(unit).relative_to(out)}" for unit in progress.missing()]
        if missing:
            found, fix = f"{format_count(len(missing), 'unit')}, {missing[0]} first", "robocas plan run does them."
            raise PlanError("work units are missing", where=out, found=found, fix=fix)
        return join(folder, progress.chosen(), jobs=jobs, on_stage=on_stage)


def _run_units(
    executor: Executor,
    progress: Progress,
    output: OutputFolder,
    on_status: Callable[[Status], None],
    shard: Shard = (0, 1),
) -> None:
    """Do the units that are needed; which ones these are is seen as seeds fail."""
    running: dict[Any, Sequence[WorkUnit]] = {}
    killed: Counter[tuple[WorkUnit, int]] = Counter()  # jobs that ended at a unit with so many seeds done
    shown = -math.inf
    while True:
        busy = {unit for units in running.values() for unit in units}
        free = executor.jobs - len(running)
        waiting = (unit for unit in progress.missing(shard) if unit not in busy)
        units = list(islice(waiting, free * executor.units_per_job))
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
            shown = time.monotonic() + max(_LOOK, sum(part.tried for part in status.parts) / _LOOKS)
        if next(progress.missing(shard), None) is None:
            on_status(status_of(progress))
            return
        for job in _ended(running, shown):
            job.result()
            for unit in running.pop(job):
                if progress.add(unit):
                    continue
                killed[place := (unit, len(progress.partial[unit]))] += 1
                if killed[place] >= _TRIES:
                    where, fix = executor.folder.unit_folder(unit), f"See {executor.log_of(job)}; is memory short?"
                    found = f"{killed[place]} in a row"
                    raise PlanError("the jobs of this unit die", where=where, found=found, fix=fix)
                break  # the job was at this unit
        progress.check_failures()


def _ended(running: dict[Any, Sequence[WorkUnit]], until: float) -> list[Any]:
    while True:
        with deferred_interrupts():  # Ctrl-C inside could leave a lock of a future held
            ended = [job for job in running if job.done()]
        if ended or time.monotonic() > until:
            return ended
        Event().wait(_POLL)
