"""Does work units: records the episode of each seed and renders it at once, in processes that may die."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import CancelledError
from functools import partial
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
from robocas_ms3.core.files import remove
from robocas_ms3.core.outputs import sweep
from robocas_ms3.core.words import error_line
from robocas_ms3.core.workers import Limits, WorkerPool
from robocas_ms3.plans.folder import Outcome, PlanFolder, SeedFiles, Unit
from robocas_ms3.plans.stages import Recorder, Renderer

TRIES = 2
"""How often a seed is tried whose process dies, before it is left out."""
_OF_A_SEED = (LayoutError, PlanningFailed, SimulationError, DatasetError)  # other errors of ours affect all seeds


class UnitWorker:
    """Does one work unit after the other, by two processes that are kept from unit to unit.

    One process records an episode, the other one renders it: a process with a renderer can't fork, as planning does.
    """

    def __init__(self, folder: PlanFolder) -> None:
        self._folder, self._plan, self._output = folder, folder.plan, folder.open(shared=True)
        chosen = self._plan.limits
        limits = Limits(chosen.record_seconds, chosen.memory_gb), Limits(chosen.render_seconds, chosen.memory_gb)
        self._record = WorkerPool(partial(Recorder, self._plan), 1, limits=limits[0], retries=0)
        self._render = WorkerPool(partial(Renderer, self._plan), 1, limits=limits[1], retries=0)

    def do(self, unit: Unit) -> None:
        """Do the seeds of a unit that are not done; an error is one that every seed would meet."""
        for _ in self.seeds(unit):
            pass

    def seeds(self, unit: Unit) -> Iterator[SeedFiles]:
        """Do the seeds of a unit that are not done; yield the files of each, which are complete."""
        if self._folder.outcomes(unit) is not None:
            return
        for seed in unit.seeds(self._plan):
            files = self._folder.files(unit, seed)
            if files.outcome() is None:
                self._output.check_record()
                with files.temporary() as tmp:
                    outcome = self._outcome(tmp)
                    if not outcome.success:
                        for path in tmp.folder.iterdir():
                            remove(path)
                    tmp.write(outcome)
                    self._output.check_record()  # --overwrite may have started another plan
                yield files
        self._folder.complete(unit)

    def _outcome(self, files: SeedFiles) -> Outcome:
        deaths = list[str]()
        result = self._survive(self._record, "record", files, deaths)
        if result["success"] and self._plan.makes_datasets:
            result |= self._survive(self._render, "render", files, deaths)
        size = files.size() if result["success"] else 0
        return Outcome(seed=files.seed, at=time.time(), size=size, deaths=deaths, **result)

    def _survive(
        self, process: WorkerPool[SeedFiles, dict[str, Any]], stage: str, files: SeedFiles, deaths: list[str]
    ) -> dict[str, Any]:
        """Do a stage of an episode; retry it when its process dies, up to `TRIES`."""
        for _ in range(TRIES):
            try:
                return process.run(files)
            except (WorkerStartError, ImportError) as failed:
                raise PlanError("a process could not start", found=failed) from failed
            except WorkerCrashed as crash:
                reason = f"{crash.found}"
            except Exception as error:
                if not _is_of_a_seed(error):
                    raise
                reason = error_line(error, 200)
            deaths.append(f"{stage}: {reason}")
            sweep(files.folder)
        return {"success": False, "failures": [deaths[-1]]}

    def stop(self) -> None:
        """Kill the processes; `do` in another thread raises `CancelledError`."""
        self._record.stop()
        self._render.stop()

    def close(self) -> None:
        self.stop()
        self._record.close()
        self._render.close()


def _is_of_a_seed(error: Exception) -> bool:
    """Return whether an error is due to a seed: its scene or files, a bug that it has found, memory that was missing.

    Errors of the disk, the system or the installation are not: all seeds of a machine would be left out.
    """
    if isinstance(error, RobocasError):
        return isinstance(error, _OF_A_SEED)
    return not isinstance(error, CancelledError | OSError)
