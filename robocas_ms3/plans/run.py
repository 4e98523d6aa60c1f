"""Runs a plan: has work units done until every part has its episodes, then joins them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.files import make_folder, write_json
from robocas_ms3.core.locks import locked_folder
from robocas_ms3.core.outputs import OutputFolder, is_empty
from robocas_ms3.core.words import count_of
from robocas_ms3.plans.executors import Executor
from robocas_ms3.plans.folder import KIND, PLAN, check_plan_record, plan_record, read_plan, settings_of
from robocas_ms3.plans.join import damaged_episodes, has_moved, join
from robocas_ms3.plans.load import check_plan
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.progress import Progress, Shard
from robocas_ms3.plans.status import Status, status_of
from robocas_ms3.plans.units import Unit

_ROUNDS = 3  # how often episodes are made again that a disk has damaged
_TRIES = 3  # jobs in a row that may end at the same seed of a unit
_LOOK = 1.0  # s between two looks at the folder, at least
_LOOKS = 10_000.0  # seeds per second that are looked at, at most


@dataclass(frozen=True)
class Callbacks:
    """What a run calls.

    Attributes:
        progress: called now and then.
        stage: called with what is done now, when that changes.
    """

    progress: Callable[[Status], None] = lambda status: None
    stage: Callable[[str], None] = lambda text: None


def run_plan(
    plan: Plan,
    out: Path,
    open_executor: Callable[[], Executor],
    *,
    jobs: int = 1,
    overwrite: bool = False,
    callbacks: Callbacks = Callbacks(),  # noqa: B008  (frozen)
) -> dict[str, Any]:
    """Make the dataset of a plan, or continue; its content depends on the plan alone.

    Args:
        plan: the plan.
        out: gets ``plan.json``, ``units/``, and in the end ``demos/``, ``datasets/``, ``statistics/``, ``report.json``.
        open_executor: opens what has units done, in ``out``.
        jobs: processes that join.
        overwrite: replace the content of ``out``.
        callbacks: see there.

    Returns:
        The content of ``report.json``.

    Raises:
        OutputExistsError: ``out`` was started with another plan or other versions, or by another command.
        PlanError: almost all seeds of a part fail.
        RobocasError: another run writes into ``out``; or an error that every seed would meet.
    """
    check_plan(plan)
    record = plan_record(plan)
    with OutputFolder(out, KIND, settings_of(record), overwrite=overwrite) as output:
        output.start(record)
        with _opened(open_executor) as executor:
            progress = _make_episodes(plan, output, executor, callbacks)
        return join(plan, out, progress.chosen(), jobs=jobs, say=callbacks.stage)


def run_shard(
    plan: Plan,
    out: Path,
    open_executor: Callable[[], Executor],
    shard: Shard,
    callbacks: Callbacks = Callbacks(),  # noqa: B008  (frozen)
) -> bool:
    """Do the work units of a shard that are needed and not done, next to other shards in the same folder.

    Args:
        plan, out, open_executor, callbacks: as of `run_plan`.
        shard: the units.

    Returns:
        Whether no unit of the plan is missing: `join_plan` can join it.

    Raises:
        RobocasError: as `run_plan`.
    """
    check_plan(plan)
    output = OutputFolder(out, KIND)  # not entered: shards run at the same time
    if not (out / PLAN).exists():
        if not is_empty(out):
            raise PlanError("not the folder of a plan", where=out, expected=PLAN, fix="Choose another --out.")
        write_json(make_folder(out) / PLAN, plan_record(plan), sync=True)
    check_plan_record(out, plan)
    progress = Progress(plan, out)
    if next(progress.missing(shard), None) is not None:
        with _opened(open_executor) as executor:
            _do_units(progress, output, executor, callbacks, shard)
    progress.read()
    return next(progress.missing(), None) is None


def join_plan(out: Path, *, jobs: int = 1, say: Callable[[str], None] = lambda text: None) -> dict[str, Any]:
    """Join the episodes of a plan whose work units are done.

    Returns:
        The content of ``report.json``.

    Raises:
        PlanError: units are missing, files are damaged, or this machine has other versions.
        RobocasError: another run writes into ``out``.
    """
    plan = read_plan(out)
    check_plan_record(out, plan)
    with locked_folder(out):
        progress = Progress(plan, out)
        if not has_moved(out):
            for unit, seeds in damaged_episodes(plan, out, progress.chosen()).items():
                progress.forget(unit, seeds)
        missing = [f"{unit.folder(plan, out).relative_to(out)}" for unit in progress.missing()]
        if missing:
            found, fix = f"{count_of(len(missing), 'unit')}, {missing[0]} first", "robocas plan run does them."
            raise PlanError("work units are missing", where=out, found=found, fix=fix)
        return join(plan, out, progress.chosen(), jobs=jobs, say=say)


@contextmanager
def _opened(open_executor: Callable[[], Executor]) -> Iterator[Executor]:
    executor = open_executor()
    try:
        yield executor
    finally:
        executor.close()


def _make_episodes(plan: Plan, output: OutputFolder, executor: Executor, callbacks: Callbacks) -> Progress:
    """Do units until there are enough episodes, whose files have the sizes that they were written with."""
    out = output.path
    progress = Progress(plan, out)
    for _ in range(_ROUNDS):
        _do_units(progress, output, executor, callbacks)
        damaged = {} if has_moved(out) else damaged_episodes(plan, out, progress.chosen())
        if not damaged:
            return progress
        callbacks.stage(f"{count_of(sum(map(len, damaged.values())), 'episode')} again: their files are damaged")
        for unit, seeds in damaged.items():
            progress.forget(unit, seeds)
    unit = min(damaged)
    found, fix = f"seed {damaged[unit][0]}, made {_ROUNDS} times", "Check the disk; then run the command again."
    where = unit.folder(plan, out)
    raise PlanError("files don't keep the sizes that they were written with", where=where, found=found, fix=fix)


def _do_units(
    progress: Progress, output: OutputFolder, executor: Executor, callbacks: Callbacks, shard: Shard | None = None
) -> None:
    """Do the units that are needed; which ones these are is seen as seeds fail."""
    running: dict[Any, Sequence[Unit]] = {}
    failures = _JobFailures(progress.plan, output.path)
    shown = -math.inf
    while True:
        busy = {unit for units in running.values() for unit in units}
        free = executor.jobs - len(running)
        waiting = (unit for unit in progress.missing(shard) if unit not in busy)
        groups = _grouped(list(islice(waiting, free * executor.units_per_job)), free)
        running |= zip(executor.submit(groups), groups, strict=False) if groups else {}
        if time.monotonic() > shown:
            output.check_exists()
            progress.read()
            progress.check_failures()
            status = status_of(progress)
            callbacks.progress(status)
            shown = time.monotonic() + max(_LOOK, sum(part.tried for part in status.parts) / _LOOKS)
        if next(progress.missing(shard), None) is None:
            callbacks.progress(status_of(progress))
            return
        for job in executor.ended(list(running), _LOOK):
            for unit in running.pop(job):
                if not progress.add(unit):
                    failures.add(unit, executor.log_of(job))
                    break  # the job was at this unit
        progress.check_failures()


def _grouped(units: Sequence[Unit], jobs: int) -> list[Sequence[Unit]]:
    """Divide units among jobs that are free."""
    size = math.ceil(len(units) / jobs) if jobs else 1
    return [units[first : first + size] for first in range(0, len(units), size or 1)]


class _JobFailures:
    """Counts the jobs that ended before their unit was complete, as after a kill or the loss of a node."""

    def __init__(self, plan: Plan, out: Path) -> None:
        self._plan, self._out = plan, out
        self._count: dict[Unit, tuple[int, int]] = {}  # failures in a row, at so many seeds

    def add(self, unit: Unit, log: str) -> None:
        """Count a job.

        Raises:
            PlanError: so many ended in a row, without another seed of the unit.
        """
        seeds = len(unit.partial_outcomes(self._plan, self._out))
        before, seeds_before = self._count.get(unit, (0, -1))
        count = before + 1 if seeds == seeds_before else 1
        self._count[unit] = count, seeds
        if count >= _TRIES:
            where, fix = unit.folder(self._plan, self._out), f"See {log or 'the log of the job'}; is memory short?"
            raise PlanError("the jobs of this unit die", where=where, found=f"{count} in a row", fix=fix)
