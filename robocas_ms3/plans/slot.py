"""Does a unit: records the episode of each seed and renders it at once, in processes that may die."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from robocas_ms3.documents import load_json
from robocas_ms3.errors import PlanError
from robocas_ms3.files import make_folder, write_json
from robocas_ms3.outputs import check_same, sweep
from robocas_ms3.plans.child import Child, ChildDied
from robocas_ms3.plans.plan import Plan
from robocas_ms3.plans.units import DONE, EPISODES, PLAN, Death, Outcome, Task, Unit, deaths, is_done, ledger, outcomes
from robocas_ms3.processes import Worker
from robocas_ms3.recordings.versions import versions

TRIES = 2
"""How often a seed is begun again whose process died, counting the first time."""
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
        memory = plan.limits.memory_gb
        self._record: Child[Task, dict[str, Any]] = Child(partial(stages.record, plan), memory)
        self._render: Child[Task, dict[str, Any]] = Child(partial(stages.render, plan), memory)

    def do(self, unit: Unit) -> list[Outcome]:
        """Do what is left of a unit; nobody else may be at it.

        Raises:
            RobocasError: something is wrong that another seed would meet as well.
            OSError: so is the disk.
        """
        folder = unit.folder(self._plan, self._out)
        if not is_done(folder):
            self._check_versions()
            make_folder(folder / EPISODES)
            sweep(folder)
            sweep(folder / EPISODES)
            done = outcomes(folder)
            for seed in unit.seeds(self._plan):
                if seed not in done:
                    ledger(folder).append([self._seed(Task(unit.part, seed, folder))], sync=True)
            write_json(folder / DONE, {"versions": versions()})
        found = outcomes(folder)
        return [found[seed] for seed in unit.seeds(self._plan)]

    def _check_versions(self) -> None:
        """See that this machine has what the plan was begun with: a worker's environment may be another."""
        path = self._out / PLAN
        before, fix = load_json(path).get("versions", {}), "Install the same versions wherever units are done."
        check_same(before, versions(), "this machine has other versions", where=path, fix=fix, error=PlanError)

    def _seed(self, task: Task) -> Outcome:
        limits = self._plan.limits
        recorded = self._survive(self._record, "record", task, limits.record_seconds)
        known: dict[str, Any] = {"success": False} | recorded
        if known["success"] and self._plan.makes_datasets:
            known |= self._survive(self._render, "render", task, limits.render_seconds)
            known["success"] = known["success"] and task.episode.is_dir()
        return Outcome(seed=task.seed, at=time.time(), **known)

    def _survive(self, child: Child[Task, dict[str, Any]], stage: str, task: Task, seconds: float) -> dict[str, Any]:
        """A stage of an episode; a seed whose process died is begun again, and left out if it dies again."""
        noted = deaths(task.folder)
        while True:
            died = [death for death in noted.read() if (death.seed, death.stage) == (task.seed, stage)]
            if len(died) >= TRIES:
                return {"success": False, "failures": [f"{stage}: {died[-1].why}"]}
            try:
                return child.do(task, seconds)
            except ChildDied as death:
                noted.append([Death(task.seed, stage, str(death))], sync=True)
                sweep(task.folder)
                sweep(task.folder / EPISODES)

    def close(self) -> None:
        """End the processes, whatever they are at."""
        self._record.close()
        self._render.close()
