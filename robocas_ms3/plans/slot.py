"""Does a unit: records the episode of each seed and renders it at once, in processes that may die."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from robocas_ms3.core.errors import (
    DatasetError,
    LayoutError,
    PlanError,
    PlanningFailed,
    RobocasError,
    SimulationError,
    WorkerCrashed,
    WorkerStartError,
)
from robocas_ms3.core.files import flush_to_disk, make_folder, write_json
from robocas_ms3.core.outputs import sweep
from robocas_ms3.core.workers import Limits, Worker, WorkerPool
from robocas_ms3.demos.recordings.versions import versions
from robocas_ms3.plans.begun import check_versions
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import DONE, EPISODES, Death, Outcome, Task, Unit, deaths, ledger, outcomes

TRIES = 2
"""How often a seed is begun again whose process died, counting the first time."""
_OF_A_SEED = (LayoutError, PlanningFailed, SimulationError, DatasetError)  # of our errors; others befall every seed
OpenStage = Callable[[Plan], Worker[Task, dict[str, Any]]]


@dataclass(frozen=True)
class Stages:
    """What does the stages of an episode; a test has others."""

    record: OpenStage
    render: OpenStage


def open_record(plan: Plan) -> Worker[Task, dict[str, Any]]:
    """What records, in its process."""
    from robocas_ms3.plans.record import Records

    return Records(plan)


def open_render(plan: Plan) -> Worker[Task, dict[str, Any]]:
    """What renders."""
    from robocas_ms3.plans.render import Renders

    return Renders(plan)


class Slot:
    """One place where units are done, one after the other: a core, mostly.

    An episode is recorded by one process and rendered by another, since what renders can't go back by forking. Both
    stay from unit to unit.

    Args:
        plan: of the units.
        out: the plan's folder.
        stages: what does the stages.
    """

    def __init__(self, plan: Plan, out: Path, stages: Stages | None = None) -> None:
        stages = stages or Stages(open_record, open_render)
        self._plan, self._out = plan, out
        limits = plan.limits
        self._record = _open_process(stages.record, plan, Limits(limits.record_seconds, limits.memory_gb))
        self._render = _open_process(stages.render, plan, Limits(limits.render_seconds, limits.memory_gb))

    def do(self, unit: Unit) -> list[Outcome]:
        """Do what is left of a unit; nobody else may be at it.

        Raises:
            RobocasError: something is wrong that another seed would meet as well.
            OSError: so is the disk.
        """
        for _ in self.seeds(unit):
            pass
        return unit.result(self._plan, self._out)

    def seeds(self, unit: Unit) -> Iterator[Outcome]:
        """Do what is left of a unit seed by seed; of what is given, the files are whole."""
        if unit.is_done(self._plan, self._out):
            return
        check_versions(self._out)
        folder = unit.folder(self._plan, self._out)
        _sweep(folder)
        done = outcomes(folder)
        for seed in unit.seeds(self._plan):
            if seed not in done:
                outcome = self._seed(Task(unit.part, seed, folder))
                if outcome.success:
                    flush_to_disk(folder)  # a line that is on the disk names no file that isn't
                ledger(folder).append([outcome], sync=True)
                yield outcome
        write_json(folder / DONE, {"versions": versions()})

    def _seed(self, task: Task) -> Outcome:
        task.clear()
        recorded = self._survive(self._record, "record", task)
        known: dict[str, Any] = {"success": False} | recorded
        if known["success"] and self._plan.makes_datasets:
            known |= self._survive(self._render, "render", task)
            known["success"] = known["success"] and task.episode.is_dir()
        size = task.size() if known["success"] else 0
        return Outcome(seed=task.seed, at=time.time(), size=size, **known)

    def _survive(self, process: WorkerPool[Task, dict[str, Any]], stage: str, task: Task) -> dict[str, Any]:
        """A stage of an episode; a seed whose process died is begun again, and left out if it dies again."""
        noted = deaths(task.folder)
        while True:
            died = [death for death in noted.read() if (death.seed, death.stage) == (task.seed, stage)]
            if len(died) >= TRIES:
                return {"success": False, "failures": [f"{stage}: {died[-1].why}"]}
            try:
                return process.run(task)
            except WorkerStartError as failed:  # it would befall every seed
                raise PlanError("a process could not begin", found=failed) from failed
            except WorkerCrashed as death:
                why = str(death.found)
            except Exception as error:
                if not _is_of_a_seed(error):
                    raise
                why = f"{type(error).__name__}: {error}".splitlines()[0][:200]
            noted.append([Death(task.seed, stage, why)], sync=True)
            _sweep(task.folder)

    def stop(self) -> None:
        """Want nothing more; `do` in another thread raises `CancelledError`."""
        self._record.stop()
        self._render.stop()

    def close(self) -> None:
        """End the processes, whatever they are at."""
        self.stop()
        self._record.close()
        self._render.close()


def _open_process(stage: OpenStage, plan: Plan, limits: Limits) -> WorkerPool[Task, dict[str, Any]]:
    return WorkerPool(partial(_open_stage, stage, plan), 1, limits=limits, retries=0)


def _open_stage(stage: OpenStage, plan: Plan) -> Worker[Task, dict[str, Any]]:
    try:
        return stage(plan)
    except Exception as error:  # it would befall every seed
        raise PlanError("a process could not begin", found=error) from error


def _is_of_a_seed(error: Exception) -> bool:
    """Whether an error is a seed's own: one of its scene or files, a bug that it has found, memory that was missing.

    What is wrong with the disk, the system or what is installed is not: all seeds of a machine would be left out.
    """
    if isinstance(error, RobocasError):
        return isinstance(error, _OF_A_SEED)
    return not isinstance(error, CancelledError | OSError)


def _sweep(folder: Path) -> None:
    """Remove what a process that died left half written."""
    make_folder(folder / EPISODES)
    for place in (folder, *(path for path in (folder / EPISODES).iterdir() if path.is_dir())):
        sweep(place)
