"""Runs a plan: has units done until every part has its episodes, then joins them."""

from __future__ import annotations

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from robocas_ms3.core.errors import PlanError
from robocas_ms3.core.exits import deferred_interrupts
from robocas_ms3.core.files import make_folder, write_json
from robocas_ms3.core.locks import locked_folder
from robocas_ms3.core.outputs import (
    check_one_way,
    check_overwrite,
    check_run,
    check_there,
    claim_output,
    is_taken,
    sweep,
    while_there,
)
from robocas_ms3.core.words import count_of
from robocas_ms3.plans.begun import check_plan_of, content_of
from robocas_ms3.plans.checks import check_plan
from robocas_ms3.plans.claims import refuse_claimed
from robocas_ms3.plans.driver import new_run, refuse_other, sole, wait_for_killed
from robocas_ms3.plans.engines import Engine
from robocas_ms3.plans.join import has_begun, join
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.tally import Tally, tally_path
from robocas_ms3.plans.units import CLAIMS, DRIVER, PLAN, Outcome, Task, Unit, outcomes

_AHEAD = 2  # units a slot that are under way, so that none waits for the next
_ROUNDS = 3  # so often is made again what a disk does not keep
_LOOK = 1.0  # s between two looks at what is under way, at least
_WAIT = 0.2  # s until a signal is handled
_LOOKS = 200.0  # units a second that are looked at, at most
_log = logging.getLogger(__name__)
OpenEngine = Callable[[Plan, Path], Engine]
OnProgress = Callable[[Sequence[int]], None]
"""Takes the episodes there are of each part, not more than were asked for."""


def run_plan(
    plan: Plan,
    out: Path,
    open_engine: OpenEngine,
    *,
    resume: bool = False,
    overwrite: bool = False,
    jobs: int = 1,
    on_start: Callable[[], None] = lambda: None,
    on_progress: OnProgress = lambda counts: None,
    on_stage: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Make what a plan says; which episodes come of it depends on the plan alone.

    Args:
        plan: it.
        out: gets ``plan.json``, ``units/``, and in the end ``demos/``, ``datasets/``, ``statistics/``, ``report.json``.
        open_engine: where units are done.
        resume: go on with what is in ``out``.
        overwrite: replace what is in ``out``.
        jobs: processes that join.
        on_start: called once plan and output turned out right.
        on_progress: called now and then.
        on_stage: called with what is done now, when that changes.

    Returns:
        The report: what is in ``report.json``.

    Raises:
        PlanError: both flags are set; ``out`` was begun with another plan or other versions; somebody is at it; or far
            too many seeds of a part fail.
        OutputExistsError: ``out`` is not empty and neither flag is set.
        RobocasError: another run writes there; something is wrong with all episodes.
    """
    check_one_way("plan run", resume=resume, overwrite=overwrite, error=PlanError)
    check_plan(plan)
    if overwrite:
        check_overwrite(out, (PLAN,), "made by `robocas plan run`", PlanError)
        check_run(out / PLAN, "versions", "plan run", PlanError)
    with locked_folder(out) as locked:
        refuse_other(out / DRIVER, locked=locked)
        if not overwrite and is_taken(out) and not (out / PLAN).exists():
            raise PlanError("this is no plan's folder", where=out, expected=PLAN, fix="Choose another --out.")
        if overwrite:  # what goes on with it asks when it begins, unless it is of Slurm itself
            refuse_claimed(out / CLAIMS)
        wait_for_killed(out)
        claim_output(out, overwrite=overwrite, resume=resume)
        if is_taken(out):
            check_plan_of(out, plan)
        elif resume:
            _log.warning("%s: no plan was begun there, so it begins", out)
        sweep(make_folder(out))
        with while_there(out / PLAN, PlanError), sole(out / DRIVER, locked=locked):
            write_json(out / PLAN, content_of(plan))
            on_start()
            with new_run(out) as run:
                engine = open_engine(plan, out)
                try:
                    run.write(engine.lingers)
                    parts = _do_all(plan, out, engine, on_progress, on_stage)
                finally:
                    engine.close()
            return join(plan, out, {part.number: list(part.chosen()) for part in parts}, jobs=jobs, say=on_stage)


@dataclass
class _Part:
    """How far a part is."""

    plan: Plan
    number: int
    done: dict[int, list[Outcome]] = field(default_factory=dict)
    next_block: int = 0
    good: int = 0
    """Episodes of units that are done."""
    judged: int = 0
    """So many blocks without a gap have been looked at for failures: the verdict must not depend on who is first."""
    judged_seeds: int = 0
    judged_good: int = 0
    tally: Tally = field(default_factory=Tally)
    """For `status`."""
    written: int = -1
    """So many units the tally had when it was written last."""

    def wants_more(self) -> bool:
        """Whether there may be too few even if all that is under way succeeds."""
        under_way = (self.next_block - len(self.done)) * self.plan.block_of(self.number)
        return self.good + under_way < self.plan.parts[self.number].episodes

    def next(self) -> Unit:
        unit = Unit(self.number, self.next_block)
        self.next_block += 1
        return unit

    def take(self, unit: Unit, found: list[Outcome], out: Path) -> None:
        """Note what came of a unit.

        Raises:
            PlanError: hardly anything succeeds.
        """
        self.done[unit.block] = found
        self.tally.add(unit.block, found)
        self.good += sum(outcome.success for outcome in found)
        while self.judged in self.done:
            block = self.done[self.judged]
            self.judged += 1
            self.judged_seeds += len(block)
            self.judged_good += sum(outcome.success for outcome in block)
            failed = self.judged_seeds - self.judged_good
            if failed > max(20, 3 * self.judged_good):
                where, found_now = (
                    unit.folder(self.plan, out).parent,
                    f"{failed} of {self.judged_seeds}{self._mostly()}",
                )
                fix = "See seeds.jsonl there; a smaller objects.count may help."
                raise PlanError("far too many seeds fail", where=where, found=found_now, fix=fix)

    def _mostly(self) -> str:
        """What most of what failed says."""
        said = Counter(one.failures[-1] for done in self.done.values() for one in done if one.failures)
        return f", most of them: {said.most_common(1)[0][0]}" if said else ""

    def write_tally(self, out: Path) -> None:
        """Say in the plan's folder what came of the units that are done, if there are more of them."""
        if len(self.done) > self.written:
            self.written = len(self.done)
            self.tally.write(tally_path(out, f"{self.plan.parts[self.number].name}"))

    def chosen(self) -> Iterator[tuple[Unit, Outcome]]:
        """The first episodes in the order of their seeds, as many as were asked for."""
        left = self.plan.parts[self.number].episodes
        for block in sorted(self.done):
            for outcome in self.done[block]:
                if outcome.success and left:
                    left -= 1
                    yield Unit(self.number, block), outcome


def _do_all(
    plan: Plan, out: Path, engine: Engine, on_progress: OnProgress, on_stage: Callable[[str], None]
) -> list[_Part]:
    """Do units until there are enough episodes, all of whose files are as they were written.

    Raises:
        PlanError: they never are; or one of `_do_units`.
    """
    damaged: dict[Unit, list[int]] = {}
    for _ in range(_ROUNDS):
        parts = [_Part(plan, number) for number in range(len(plan.parts))]
        _do_units(plan, out, engine, parts, on_progress)
        damaged = {} if has_begun(out) else _damaged(plan, out, parts)
        if not damaged:
            return parts
        count = sum(map(len, damaged.values()))
        on_stage(f"{count_of(count, 'episode')} again: their files are not what was written")
        for unit, seeds in damaged.items():
            unit.forget(plan, out, seeds)
    unit = min(damaged)
    where, fix = unit.folder(plan, out), "Look at the disk; then --resume."
    found = f"seed {damaged[unit][0]}, made {_ROUNDS} times"
    raise PlanError("files don't keep the sizes that they were written with", where=where, found=found, fix=fix)


def _damaged(plan: Plan, out: Path, parts: Sequence[_Part]) -> dict[Unit, list[int]]:
    """Seeds of units whose files have other sizes than they had, as those of a disk with errors may."""
    found: dict[Unit, list[int]] = {}
    for part in parts:
        for unit, outcome in part.chosen():
            if Task(unit.part, outcome.seed, unit.folder(plan, out)).size() != outcome.size:
                found.setdefault(unit, []).append(outcome.seed)
    return found


def _do_units(plan: Plan, out: Path, engine: Engine, parts: Sequence[_Part], on_progress: OnProgress) -> None:
    under_way: dict[Future[list[Outcome]], Unit] = {}
    done: SimpleQueue[Future[list[Outcome]]] = SimpleQueue()  # not `concurrent.futures.wait`: see `Pool`
    said = -math.inf
    while True:
        for part in parts:
            while part.wants_more() and len(under_way) < _AHEAD * engine.slots:
                unit = part.next()
                if unit.is_done(plan, out):
                    part.take(unit, unit.result(plan, out), out)
                else:
                    future = engine.submit(unit)
                    under_way[future] = unit
                    future.add_done_callback(done.put)
        pause = max(_LOOK, len(under_way) / _LOOKS)  # each look reads as many files
        if not under_way or time.monotonic() > said + pause:
            check_there(out / PLAN, PlanError)
            for part in parts:
                part.write_tally(out)
            on_progress(_counts(plan, out, parts, under_way))
            said = time.monotonic()
        if not under_way:
            return
        for future in _some_done(done):
            unit = under_way.pop(future)
            parts[unit.part].take(unit, future.result(), out)


def _some_done(done: SimpleQueue[Future[Any]]) -> Iterator[Future[Any]]:
    """What is done by now; waits a moment for the first."""
    with suppress(Empty):
        with deferred_interrupts():
            first = done.get(timeout=_WAIT)
        yield first
        while True:
            yield done.get_nowait()


def _counts(plan: Plan, out: Path, parts: Sequence[_Part], under_way: Mapping[Any, Unit]) -> list[int]:
    counts = [part.good for part in parts]
    for unit in under_way.values():
        counts[unit.part] += sum(outcome.success for outcome in outcomes(unit.folder(plan, out)).values())
    return [min(count, one.episodes) for count, one in zip(counts, plan.parts, strict=True)]
